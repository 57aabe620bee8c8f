"""Runs structure from motion with pycolmap to find the cameras and points of a set of images.

COLMAP's log goes to files in the work folder; the user sees a progress bar for each stage.
"""

from __future__ import annotations

import tempfile
import zlib  # noqa: F401  pycolmap 4.2.1 corrupts the heap if it is imported before zlib
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from xrgs.config import SfmConf
from xrgs.mixture.views import Reconstruction
from xrgs.photos import images
from xrgs.photos.lens import lens_of_model
from xrgs.photos.masks import MASKS
from xrgs.runtime.machine import usable_cores
from xrgs.runtime.progress import ProgressBar
from xrgs.runtime.signals import handlers_kept
from xrgs.runtime.text import listed

with handlers_kept():
    import pycolmap

#: Number of features of all images together with which exhaustive matching takes minutes on two
#: cores.
_TOTAL_FEATURES = 100_000
#: COLMAP's default of `max_num_features`, for each image.
_MAX_FEATURES = 8192
#: Largest longer side at which features are detected at twice the resolution, px: half the default
#: of `variant.sfm.long_side`, so that SIFT takes no longer than at that size.
_SMALL_SIDE = 800
#: Least triangulation angle for two images, which may have a narrow baseline, degrees.
_TWO_VIEW_ANGLE = 0.2
#: Ratio of the least inliers of the first pair and of a later view: COLMAP's defaults of
#: `init_min_num_inliers` and `abs_pose_min_num_inliers`.
_FIRST_PAIR_RATIO = 100 / 30
#: The entries of K that are the parameters of COLMAP's PINHOLE camera.
_PINHOLE_ENTRIES = ((0, 0), (1, 1), (0, 2), (1, 2))
#: Thresholds for separate cameras: least number of images, iterations of the refinement, largest
#: ratio of the reprojection errors after and before it, and largest ratio of focal lengths that
#: count as equal. Our choice: with separate cameras, the focal lengths of fern's 20 photographs
#: agree to 0.7 %, and the ratio of the errors is 0.998.
_LEAST_SHARING, _OWN_ITERATIONS, _BETTER, _SAME_FOCAL = 3, 30, 0.97, 1.05


@dataclass(frozen=True)
class SfmImage:
    """An image for SfM."""

    file: str
    """Path of the image, relative to the folder of all images."""
    name: str
    """Name of the photograph, for messages."""
    camera: str
    """Name of the camera; images with the same name share the camera."""
    K: NDArray[np.float64] | None = None
    """Intrinsics [3, 3], px, if known. They are not refined, and there is no distortion."""
    focal: float | None = None
    """Focal length from EXIF, px, the initial value of the refinement; None if unknown."""
    masked: bool = False
    """Whether a mask (`xrgs.photos.masks.copy_mask` of the file) restricts the features."""


def features_per_image(images: int, configured: int) -> int:
    """Return `variant.sfm.max_num_features`; if it is 0, choose a number of features per image.

    The choice keeps exhaustive matching short, and is at most COLMAP's default of 8192.
    """
    return configured or min(_MAX_FEATURES, _TOTAL_FEATURES // max(images, 1))


def first_octave(long_side: int, configured: int | None) -> int:
    """Return `variant.sfm.first_octave`; if it is None, choose -1 up to 800 px and 0 above.

    -1 detects features at twice the resolution, which is better for small images. On the embedded
    scene with mixed resolution, at 250 px and at 500 px, it gave 1.7 to 2 times as many points and
    3 to 21% less position error. For 37 photographs of bonsai (Mip-NeRF 360), HR at 800 px and LR
    at 160 px, it placed 18 instead of 3. `long_side` is the longest side of all images, px.
    """
    if configured is not None:
        return configured
    return -1 if long_side <= _SMALL_SIDE else 0


def reconstruct(
    sfm_images: Sequence[SfmImage], folder: Path, work: Path, conf: SfmConf
) -> Reconstruction:
    """Find cameras and points by exhaustive matching and incremental mapping.

    The result has the same bits for any number of threads: images have the same ids, RANSAC the
    same random numbers, and one thread matches. On a processor with another size of the first-level
    data cache, an image that is registered by more than 168 points has a pose with other last
    digits (`findings/pycolmap_cache_size.sh`).

    Args:
        sfm_images: The images; those without `K` get a SIMPLE_RADIAL camera for each `camera` name.
        folder: The folder that `SfmImage.file` is relative to.
        work: An existing folder for COLMAP's database, models and logs. Features and matches of
            an earlier call with the same images, `max_num_features` and `first_octave` are reused.
        conf: The settings.

    Returns:
        The largest model; empty if COLMAP found none.
    """
    database = work / "database.db"
    features = _find_matches(sfm_images, folder, database, conf)
    models = _map(sfm_images, folder, database, work, conf)
    report = features | {
        "images": len(sfm_images),
        "init_min_tri_angle": conf.init_min_tri_angle,
        "lr_images": conf.lr_images,
        "min_inliers": conf.min_inliers,
        "points": 0,
        "pycolmap": pycolmap.__version__,
        "registered": 0,
        "models": sorted((model.num_reg_images() for model in models), reverse=True),
        "notes": [],
    }
    if not models:
        no_points = np.zeros((0, 3))
        return Reconstruction({}, {}, no_points, no_points.astype(np.uint8), {}, report)
    largest = max(models, key=lambda m: (m.num_reg_images(), m.num_points3D()))
    bogus = bogus_cameras(largest, sfm_images)
    report["notes"] = list(_notes(sfm_images, bogus))
    index = {image.file: i for i, image in enumerate(sfm_images) if i not in bogus}
    refined = {s.file: (i, s.camera) for i, s in enumerate(sfm_images) if s.K is None}
    apart = other_cameras(largest, refined)
    return replace(to_numpy(largest, index, report), apart=apart)


def _notes(sfm_images: Sequence[SfmImage], bogus: Mapping[int, str]) -> Iterator[str]:
    if bogus:
        cameras = [f"{sfm_images[i].name} ({params})" for i, params in sorted(bogus.items())]
        yield f"not placed, because SfM made an impossible camera: {listed(cameras)}"
    if len(sfm_images) == 2 and all(i.K is None and i.focal is None for i in sfm_images):
        yield (
            "the focal length is a guess, 1.2 times the longer side: two photographs do not tell "
            "it, and EXIF does not give it"
        )


def triangulate(
    sfm_images: Sequence[SfmImage],
    viewmats: Sequence[NDArray[np.float64]],
    folder: Path,
    work: Path,
    conf: SfmConf,
) -> Reconstruction:
    """Triangulate points from images with known cameras and poses, by exhaustive matching.

    Each image has `K` and its own camera, and `viewmats` its world to camera [4, 4]; the rest is as
    for `reconstruct`.
    """
    database = work / "database.db"
    features = _find_matches(sfm_images, folder, database, conf)
    index = {image.file: i for i, image in enumerate(sfm_images)}
    posed = pycolmap.Reconstruction()
    with pycolmap.Database.open(database) as opened:
        for camera in opened.read_all_cameras():
            posed.add_camera_with_trivial_rig(camera)
        for image in opened.read_all_images():
            pose = pycolmap.Rigid3d(viewmats[index[image.name]][:3])
            posed.add_image_with_trivial_frame(image, pose)
    options = mapping_options(conf, len(sfm_images), known=True)
    model = pycolmap.triangulate_points(posed, database, folder, work, options=options)
    return to_numpy(model, index, features)


def _find_matches(
    sfm_images: Sequence[SfmImage], folder: Path, database: Path, conf: SfmConf
) -> dict[str, Any]:
    """Fill a database unless it is already filled; return the settings of SIFT.

    The seed is set, and logs go to the folder of the database.
    """
    _log_to(database.parent)
    pycolmap.set_random_seed(conf.seed)
    max_features = features_per_image(len(sfm_images), conf.max_num_features)
    longest = max(max(images.size(folder / image.file)) for image in sfm_images)
    octave = first_octave(longest, conf.first_octave)
    if not database.exists():
        _name_cameras(sfm_images, folder, database)
        _extract(sfm_images, folder, database, max_features, octave)
        _match(sfm_images, database, conf.seed)
    return {"first_octave": octave, "max_num_features": max_features}


def bogus_cameras(model: Any, sfm_images: Sequence[SfmImage]) -> dict[int, str]:
    """Find images with an impossible camera, by COLMAP's limits for the parameters.

    COLMAP drops such images after every bundle adjustment except the last, so that the final model
    may contain a negative focal length. Images with `K` are not checked.

    Returns:
        Index of an image with an impossible camera -> the camera's parameters.
    """
    limits = pycolmap.IncrementalMapperOptions()
    refined = {image.file: i for i, image in enumerate(sfm_images) if image.K is None}
    found = {}
    for image in model.images.values():
        camera = model.cameras[image.camera_id]
        if (
            image.has_pose
            and image.name in refined
            and camera.has_bogus_params(
                limits.min_focal_length_ratio, limits.max_focal_length_ratio, limits.max_extra_param
            )
        ):
            found[refined[image.name]] = camera.params_to_string()
    return found


def _log_to(work: Path) -> None:
    """Redirect COLMAP's log from the terminal to files in `work`."""
    log = pycolmap.logging
    log.logtostderr = log.alsologtostderr = False
    log.stderrthreshold = int(log.FATAL.value)
    for level in (log.INFO, log.WARNING, log.ERROR):
        log.set_log_destination(level, str(work / f"colmap-{level.name}-"))


def _name_cameras(sfm_images: Sequence[SfmImage], folder: Path, database: Path) -> None:
    """Write images and cameras into a new database, in the given order.

    Otherwise the threads that extract features would number images in the order they finish, and
    the ids decide the order of all later stages.
    """
    with pycolmap.Database.open(database):
        pass
    groups: dict[str, list[SfmImage]] = {}
    for image in sfm_images:
        groups.setdefault(image.camera, []).append(image)
    for group in groups.values():
        first, reader = group[0], pycolmap.ImageReaderOptions()
        if first.K is not None:
            reader.camera_model = "PINHOLE"
            values = (repr(float(first.K[i, j])) for i, j in _PINHOLE_ENTRIES)
            reader.camera_params = ",".join(values)
        elif first.focal is not None:
            width, height = images.size(folder / first.file)
            reader.camera_params = f"{float(first.focal)},{width / 2},{height / 2},0"
        pycolmap.import_images(
            database,
            folder,
            camera_mode=pycolmap.CameraMode.SINGLE,
            image_names=[image.file for image in group],
            options=reader,
        )


def _extract(
    sfm_images: Sequence[SfmImage],
    folder: Path,
    database: Path,
    max_features: int,
    octave: int,
) -> None:
    threads = usable_cores()
    options = pycolmap.FeatureExtractionOptions()
    options.num_threads = threads
    options.sift.max_num_features = max_features
    options.sift.first_octave = octave
    with ProgressBar("SfM: features", "view", len(sfm_images)) as bar:
        for batch in _batches(sfm_images, 2 * threads):
            reader = pycolmap.ImageReaderOptions()
            if batch[0].masked:  # COLMAP skips images without a mask file
                reader.mask_path = folder / MASKS
            pycolmap.extract_features(
                database,
                folder,
                image_names=[image.file for image in batch],
                reader_options=reader,
                extraction_options=options,
                device=pycolmap.Device.cpu,
            )
            bar.update(len(batch))


def _batches(sfm_images: Sequence[SfmImage], size: int) -> Iterator[list[SfmImage]]:
    """Yield images in batches of at most `size`, so that progress can be shown in between.

    In a batch, all images have masks or none has.
    """
    for masked in (False, True):
        group = [image for image in sfm_images if image.masked == masked]
        for start in range(0, len(group), size):
            yield group[start : start + size]


def _match(sfm_images: Sequence[SfmImage], database: Path, seed: int) -> None:
    """Match every pair of images: each image with all images before it."""
    matching = pycolmap.FeatureMatchingOptions()
    # On several threads, pairs at times lose matches (`findings/pycolmap_matcher_threads.sh`).
    matching.num_threads = 1
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = seed  # of each pair, on any thread
    pairing = pycolmap.ImportedPairingOptions()
    pairing.match_list_path = listed_pairs = database.with_name("pairs.txt")
    pairs = len(sfm_images) * (len(sfm_images) - 1) // 2
    with ProgressBar("SfM: matches", "pair", pairs) as bar:
        for i in range(1, len(sfm_images)):
            lines = [f"{image.file} {sfm_images[i].file}\n" for image in sfm_images[:i]]
            listed_pairs.write_text("".join(lines), encoding="utf-8")
            pycolmap.match_image_pairs(
                database,
                matching_options=matching,
                pairing_options=pairing,
                verification_options=verification,
                device=pycolmap.Device.cpu,
            )
            bar.update(i)


def _map(
    sfm_images: Sequence[SfmImage], folder: Path, database: Path, work: Path, conf: SfmConf
) -> list[Any]:
    options = mapping_options(conf, len(sfm_images), known=all(s.K is not None for s in sfm_images))
    out = Path(tempfile.mkdtemp(prefix="models-", dir=work))
    with ProgressBar("SfM: cameras", "view", len(sfm_images)) as bar:
        models = pycolmap.incremental_mapping(
            database,
            folder,
            out,
            options=options,
            next_image_callback=lambda: bar.update(int(bar.n < len(sfm_images))),
        )
    return list(models.values())


def mapping_options(conf: SfmConf, count: int, *, known: bool) -> Any:
    """Return pycolmap's `IncrementalPipelineOptions` for the incremental mapping.

    Args:
        conf: The settings.
        count: The number of images. With two, COLMAP's defaults would drop every point.
        known: Whether the intrinsics of all images are known and not to be refined.
    """
    options = pycolmap.IncrementalPipelineOptions()
    options.random_seed = conf.seed
    options.num_threads = 1  # the order of sums would vary with several threads
    options.mapper.init_min_tri_angle = conf.init_min_tri_angle
    options.mapper.abs_pose_min_num_inliers = conf.min_inliers
    options.mapper.init_min_num_inliers = round(conf.min_inliers * _FIRST_PAIR_RATIO)
    options.min_model_size = min(count, options.min_model_size)
    if count == 2:
        # By default COLMAP drops points that only two images observe: here, all points.
        options.triangulation.ignore_two_view_tracks = False
        options.triangulation.min_angle = _TWO_VIEW_ANGLE
        options.mapper.filter_min_tri_angle = _TWO_VIEW_ANGLE
        options.mapper.init_min_tri_angle = _TWO_VIEW_ANGLE
        options.mapper.init_max_forward_motion = 1.0
    if known or count == 2:  # from two views, focal length and depth can't be told apart
        options.ba_refine_focal_length = False
        options.ba_refine_extra_params = False
        options.mapper.abs_pose_refine_focal_length = False
        options.mapper.abs_pose_refine_extra_params = False
    return options


def to_numpy(model: Any, index: Mapping[str, int], report: Mapping[str, Any]) -> Reconstruction:
    """Convert pycolmap's `Reconstruction` into numpy arrays, with points in the order of their ids.

    `index` has the indices of the images by their names in the model; other images are left out.
    `report` has entries besides the results. XrgsError if a camera model is not supported.
    """
    order = sorted(model.points3D)
    number = {point: p for p, point in enumerate(order)}
    lenses, viewmats, observed = {}, {}, {}
    for image in model.images.values():
        if not image.has_pose or image.name not in index:
            continue
        i = index[image.name]
        viewmats[i] = np.vstack([image.cam_from_world().matrix(), [0.0, 0.0, 0.0, 1.0]])
        camera = model.cameras[image.camera_id]
        params = [float(value) for value in camera.params]
        lenses[i] = lens_of_model(camera.model_name, (camera.width, camera.height), params)
        own = {number[p.point3D_id] for p in image.points2D if p.has_point3D()}
        observed[i] = np.array(sorted(own), dtype=np.intp)
    points = np.array([model.points3D[p].xyz for p in order], dtype=np.float64).reshape(-1, 3)
    colors = np.array([model.points3D[p].color for p in order], dtype=np.uint8).reshape(-1, 3)
    results: dict[str, Any] = {"registered": len(viewmats), "points": len(points)}
    if model.compute_num_observations():  # models of other programs may have no observations
        results["reprojection_error_px"] = reprojection_error(model)
    return Reconstruction(lenses, viewmats, points, colors, observed, {**report, **results})


def other_cameras(model: Any, cameras: Mapping[str, tuple[int, str]]) -> dict[int, int]:
    """Find the images that fit better with another camera than the shared one.

    Each image gets its own camera, and focal lengths, poses and points are refined together. Images
    are found if this reduces the reprojection error by at least 3 %, and if their focal lengths
    then differ by more than 5 % from those of the other images with the shared camera.

    Args:
        model: pycolmap's `Reconstruction`. Only the errors that it stores with its points change.
        cameras: Name of an image in the model -> its index and the name of its camera; images with
            the same camera name share a camera. Other images are ignored.

    Returns:
        Index of a found image -> number of its focal length; images with the same number have the
        same focal length.
    """
    sharing = Counter(camera for _, camera in cameras.values())
    shared = {name for name, (_, camera) in cameras.items() if sharing[camera] >= _LEAST_SHARING}
    if not any(image.has_pose and image.name in shared for image in model.images.values()):
        return {}
    own = _with_own_cameras(model)
    if not reprojection_error(own) < _BETTER * reprojection_error(model):
        return {}
    focals: dict[str, dict[int, float]] = {}
    for image in own.images.values():
        if image.name in shared:
            index, camera = cameras[image.name]
            focal = own.cameras[image.camera_id].mean_focal_length()
            focals.setdefault(camera, {})[index] = focal
    apart: dict[int, int] = {}
    for of_camera in focals.values():
        groups = groups_of_focals(of_camera)
        usual = max(groups, key=len)
        for number, group in enumerate((g for g in groups if g is not usual), len(apart) + 1):
            apart |= dict.fromkeys(group, number)
    return apart


def reprojection_error(model: Any) -> float:
    """Return the mean reprojection error of pycolmap's `Reconstruction`, px.

    The errors are updated first: `compute_mean_reprojection_error` averages stored errors, which
    may be from before the last change of the model.
    """
    model.update_point_3d_errors()
    return float(model.compute_mean_reprojection_error())


def groups_of_focals(focals: Mapping[int, float]) -> list[list[int]]:
    """Group images by focal length, with gaps of more than 5 % between groups."""
    groups: list[list[int]] = []
    before = 0.0
    for index, focal in sorted(focals.items(), key=lambda item: item[1]):
        if before <= 0 or focal > _SAME_FOCAL * before:
            groups.append([])
        groups[-1].append(index)
        before = focal
    return groups


def _with_own_cameras(model: Any) -> Any:
    """Copy a model, give each image its own camera, and refine all parameters except distortion."""
    own = pycolmap.Reconstruction()
    for image in model.images.values():
        if not image.has_pose:
            continue
        camera = pycolmap.Camera(model.cameras[image.camera_id].todict())
        camera.camera_id = image.image_id
        own.add_camera_with_trivial_rig(camera)
        points = pycolmap.Point2DList([pycolmap.Point2D(point.xy) for point in image.points2D])
        copy = pycolmap.Image(
            name=image.name, points2D=points, camera_id=image.image_id, image_id=image.image_id
        )
        own.add_image_with_trivial_frame(copy, image.cam_from_world())
    for point in model.points3D.values():
        own.add_point3D(point.xyz, point.track, point.color)
    options = pycolmap.BundleAdjustmentOptions(refine_extra_params=False, print_summary=False)
    options.ceres.solver_options.num_threads = 1
    options.ceres.solver_options.max_num_iterations = _OWN_ITERATIONS
    config = pycolmap.BundleAdjustmentConfig()
    for number in own.images:
        config.add_image(number)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    pycolmap.create_default_bundle_adjuster(options, config, own).solve()
    return own
