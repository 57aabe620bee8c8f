"""Structure from motion with pycolmap, and nothing else: cameras and points of a set of images.

COLMAP's own log goes to a file in the work folder; what the user sees is one bar a stage.
"""

from __future__ import annotations

import tempfile
import zlib  # noqa: F401  as a first import pycolmap 4.2.1 corrupts the heap
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pycolmap
from numpy.typing import NDArray

from xrgs.capture import images
from xrgs.capture.images import Lens
from xrgs.runtime.machine import usable_cores
from xrgs.runtime.progress import Bar

if TYPE_CHECKING:
    from xrgs.config import SfmConf

#: Features over all images that keep exhaustive matching at minutes on two cores.
_FEATURES_IN_ALL = 100_000
_MOST_FEATURES = 8192
#: Longer side, px, up to which features are sought at twice the resolution.
_SMALL = 640
#: Two views of a narrow baseline: the angle (degrees) below which a point tells nothing of depth.
_TWO_VIEW_ANGLE = 0.2
#: COLMAP asks the first pair for 100 inliers, a later view for 30.
_FIRST_PAIR = 100 / 30
#: Where a PINHOLE camera's parameters stand in K.
_PINHOLE = ((0, 0), (1, 1), (0, 2), (1, 2))


@dataclass(frozen=True)
class Shot:
    """One image that SfM is to place."""

    file: str
    """Relative to the folder of all images."""
    camera: str
    """Shots of one name share one camera."""
    K: NDArray[np.float64] | None = None
    """[3, 3] px where known: then there is no distortion, and nothing is refined."""


@dataclass(frozen=True)
class Reconstruction:
    """The largest model found; empty where there is none. Keys are indices of the shots."""

    lenses: dict[int, Lens]
    viewmats: dict[int, NDArray[np.float64]]  # [4, 4] world to camera
    points: NDArray[np.float64]  # [P, 3]
    colors: NDArray[np.uint8]  # [P, 3]
    tracked: dict[int, NDArray[np.intp]]
    """Indices of the points found in each shot, ascending."""
    report: dict[str, Any]


def features_for(count: int, asked: int) -> int:
    """Features an image: what was asked for, or (0) what keeps exhaustive matching quick."""
    return asked or min(_MOST_FEATURES, _FEATURES_IN_ALL // max(count, 1))


def octave_for(long_side: int, asked: int | None) -> int:
    """SIFT's first octave: what was asked for; else 0, the recipe's, or -1 for small images.

    On the embedded scene, mixed, -1 gave 1.7 to 2 times the points and 3 to 21% less position
    error at 250 and at 500 px.
    """
    if asked is not None:
        return asked
    return -1 if long_side <= _SMALL else 0


def reconstruct(shots: Sequence[Shot], folder: Path, work: Path, conf: SfmConf) -> Reconstruction:
    """Cameras and points of `shots`, by exhaustive matching and incremental mapping.

    Args:
        shots: The images; those without `K` get one SIMPLE_RADIAL camera per `camera` name.
        folder: What `Shot.file` is relative to.
        work: An existing folder for COLMAP's database, models and logs. Features and matches that
            an earlier call left there are taken as they are: it must have been of the same shots,
            features and octave.
        conf: The recipe.

    Not reproducible across machines, nor quite between runs: keep what it returned.
    """
    _log_to(work)
    pycolmap.set_random_seed(conf.seed)
    database = work / "database.db"
    threads = usable_cores()
    max_features = features_for(len(shots), conf.max_num_features)
    longest = max(max(images.size(folder / shot.file)) for shot in shots)
    octave = octave_for(longest, conf.first_octave)
    if not database.exists():
        _extract(shots, folder, database, max_features, octave, threads)
        _match(shots, database, work, threads)
    models = _map(shots, folder, database, work, conf, threads)
    report = {
        "first_octave": octave,
        "images": len(shots),
        "init_min_tri_angle": conf.init_min_tri_angle,
        "lr_images": conf.lr_images,
        "max_num_features": max_features,
        "min_inliers": conf.min_inliers,
        "points": 0,
        "pycolmap": pycolmap.__version__,
        "registered": 0,
        "models": sorted((model.num_reg_images() for model in models), reverse=True),
    }
    if not models:
        nothing = np.zeros((0, 3))
        return Reconstruction({}, {}, nothing, nothing.astype(np.uint8), {}, report)
    return _as_plain(
        max(models, key=lambda m: (m.num_reg_images(), m.num_points3D())), shots, report
    )


def _log_to(work: Path) -> None:
    """COLMAP's log into `work`, and out of the terminal."""
    log = pycolmap.logging
    log.logtostderr = log.alsologtostderr = False
    log.stderrthreshold = int(log.FATAL.value)
    for level in (log.INFO, log.WARNING, log.ERROR):
        log.set_log_destination(level, str(work / f"colmap-{level.name}-"))


def _extract(
    shots: Sequence[Shot],
    folder: Path,
    database: Path,
    max_features: int,
    octave: int,
    threads: int,
) -> None:
    options = pycolmap.FeatureExtractionOptions()
    options.num_threads = threads
    options.sift.max_num_features = max_features
    options.sift.first_octave = octave
    cameras: dict[str, int] = {}
    with Bar("SfM: features", "view", len(shots)) as bar:
        for camera, batch in _batches(shots, 2 * threads):
            reader = pycolmap.ImageReaderOptions()
            if camera in cameras:
                reader.existing_camera_id = cameras[camera]
            elif batch[0].K is not None:
                K = batch[0].K
                reader.camera_model = "PINHOLE"
                reader.camera_params = ",".join(repr(float(K[i, j])) for i, j in _PINHOLE)
            pycolmap.extract_features(
                database,
                folder,
                image_names=[shot.file for shot in batch],
                camera_mode=pycolmap.CameraMode.SINGLE,
                reader_options=reader,
                extraction_options=options,
                device=pycolmap.Device.cpu,
            )
            with pycolmap.Database.open(database) as opened:
                newest = max(c.camera_id for c in opened.read_all_cameras())
            cameras.setdefault(camera, newest)
            bar.update(len(batch))


def _batches(shots: Sequence[Shot], size: int) -> Iterator[tuple[str, list[Shot]]]:
    """Shots of one camera, a few at a time, so that progress can be shown between them."""
    cameras: dict[str, list[Shot]] = {}
    for shot in shots:
        cameras.setdefault(shot.camera, []).append(shot)
    for camera, group in cameras.items():
        for start in range(0, len(group), size):
            yield camera, group[start : start + size]


def _match(shots: Sequence[Shot], database: Path, work: Path, threads: int) -> None:
    """Every pair, one image against those before it at a time."""
    matching = pycolmap.FeatureMatchingOptions()
    matching.num_threads = threads
    pairing = pycolmap.ImportedPairingOptions()
    pairing.match_list_path = work / "pairs.txt"
    pairs = len(shots) * (len(shots) - 1) // 2
    with Bar("SfM: matches", "pair", pairs) as bar:
        for i in range(1, len(shots)):
            lines = [f"{shot.file} {shots[i].file}\n" for shot in shots[:i]]
            (work / "pairs.txt").write_text("".join(lines), encoding="utf-8")
            pycolmap.match_image_pairs(
                database,
                matching_options=matching,
                pairing_options=pairing,
                device=pycolmap.Device.cpu,
            )
            bar.update(i)


def _map(
    shots: Sequence[Shot], folder: Path, database: Path, work: Path, conf: SfmConf, threads: int
) -> list[Any]:
    options = mapping_options(conf, len(shots), known=all(s.K is not None for s in shots))
    options.num_threads = threads
    out = Path(tempfile.mkdtemp(prefix="models-", dir=work))
    with Bar("SfM: cameras", "view", len(shots)) as bar:
        models = pycolmap.incremental_mapping(
            database,
            folder,
            out,
            options=options,
            next_image_callback=lambda: bar.update(int(bar.n < len(shots))),
        )
    return list(models.values())


def mapping_options(conf: SfmConf, count: int, *, known: bool) -> Any:
    """COLMAP's `IncrementalPipelineOptions` for so many images, intrinsics known or not."""
    options = pycolmap.IncrementalPipelineOptions()
    options.random_seed = conf.seed
    options.mapper.init_min_tri_angle = conf.init_min_tri_angle
    options.mapper.abs_pose_min_num_inliers = conf.min_inliers
    options.mapper.init_min_num_inliers = round(conf.min_inliers * _FIRST_PAIR)
    options.min_model_size = min(count, options.min_model_size)
    if count == 2:
        # By default every point that only two images see is dropped: here that is all of them.
        options.triangulation.ignore_two_view_tracks = False
        options.triangulation.min_angle = _TWO_VIEW_ANGLE
        options.mapper.filter_min_tri_angle = _TWO_VIEW_ANGLE
        options.mapper.init_min_tri_angle = _TWO_VIEW_ANGLE
        options.mapper.init_max_forward_motion = 1.0
    if known or count == 2:  # two views can't tell a focal length from a depth
        options.ba_refine_focal_length = False
        options.ba_refine_extra_params = False
        options.mapper.abs_pose_refine_focal_length = False
        options.mapper.abs_pose_refine_extra_params = False
    return options


def _as_plain(model: Any, shots: Sequence[Shot], report: dict[str, Any]) -> Reconstruction:
    """Pycolmap's model as numpy arrays, points in the order of their ids."""
    index = {shot.file: i for i, shot in enumerate(shots)}
    order = sorted(model.points3D)
    number = {point: p for p, point in enumerate(order)}
    lenses, viewmats, tracked = {}, {}, {}
    for image in model.images.values():
        if not image.has_pose:
            continue
        i = index[image.name]
        viewmats[i] = np.vstack([image.cam_from_world().matrix(), [0.0, 0.0, 0.0, 1.0]])
        lenses[i] = _lens(model.cameras[image.camera_id])
        own = {number[p.point3D_id] for p in image.points2D if p.has_point3D()}
        tracked[i] = np.array(sorted(own), dtype=np.intp)
    points = np.array([model.points3D[p].xyz for p in order], dtype=np.float64).reshape(-1, 3)
    colors = np.array([model.points3D[p].color for p in order], dtype=np.uint8).reshape(-1, 3)
    report |= {
        "registered": len(viewmats),
        "points": len(order),
        "reprojection_error_px": float(model.compute_mean_reprojection_error()),
    }
    return Reconstruction(lenses, viewmats, points, colors, tracked, report)


def _lens(camera: Any) -> Lens:
    if camera.model_name == "PINHOLE":
        fx, fy, cx, cy = (float(p) for p in camera.params)
        return Lens(camera.width, camera.height, fx, fy, cx, cy)
    f, cx, cy, k = (float(p) for p in camera.params)  # SIMPLE_RADIAL
    return Lens(camera.width, camera.height, f, f, cx, cy, k)
