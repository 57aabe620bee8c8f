"""Finds images that were cropped or zoomed, and so don't share the camera that they are given."""

from __future__ import annotations

import zlib  # noqa: F401  pycolmap 4.2.1 corrupts the heap where it is imported before zlib
from collections import Counter
from collections.abc import Mapping
from typing import Any

from xrgs.runtime.signals import handlers_kept

with handlers_kept():
    import pycolmap

#: Where images with one camera are tried with cameras of their own: the fewest images, the most
#: iterations, the share of the reprojection error that must remain at most, and the ratio of focal
#: lengths up to which they are one. Our choice: of fern's 20 photographs each has a focal length
#: within 0.7 % of the others' then, and the error 0.998 of what it was.
_LEAST_SHARING, _OWN_ITERATIONS, _BETTER, _SAME_FOCAL = 3, 30, 0.97, 1.05


def other_cameras(model: Any, cameras: Mapping[str, tuple[int, str]]) -> dict[int, int]:
    """Find the images that fit better with another camera than the one that they share.

    Each image gets a camera of its own, and focal lengths, poses and points are refined together.
    Nothing is found unless the reprojection error falls by 3 %, and the focal lengths of some are
    then 5 % from those of the others with their camera.

    Args:
        model: pycolmap's `Reconstruction`; it stays as it is, but for the errors
            that it stores with its points.
        cameras: The index of each image and the name of its camera, by the image's name in the
            model; images with one name share the camera. Others are left alone.

    Returns:
        A number by the index of each such image; images of one number have one focal length.
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
    """Project the points of pycolmap's `Reconstruction`, and return their mean error, px.

    Without the update, `compute_mean_reprojection_error` averages the errors that the model stores,
    which may be from before its last change.
    """
    model.update_point_3d_errors()
    return float(model.compute_mean_reprojection_error())


def groups_of_focals(focals: Mapping[int, float]) -> list[list[int]]:
    """Group images by focal length, where a gap of 5 % lies between two groups."""
    groups: list[list[int]] = []
    before = 0.0
    for index, focal in sorted(focals.items(), key=lambda item: item[1]):
        if before <= 0 or focal > _SAME_FOCAL * before:
            groups.append([])
        groups[-1].append(index)
        before = focal
    return groups


def _with_own_cameras(model: Any) -> Any:
    """Copy a model, give each image a camera of its own, and refine all but the distortion."""
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
