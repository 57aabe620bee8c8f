"""Finds images that were cropped or zoomed, and so need a camera different from the shared one."""

from __future__ import annotations

import zlib  # noqa: F401  pycolmap 4.2.1 corrupts the heap if it is imported before zlib
from collections import Counter
from collections.abc import Mapping
from typing import Any

from xrgs.runtime.signals import handlers_kept

with handlers_kept():
    import pycolmap

#: Thresholds for separate cameras: least number of images, iterations of the refinement, largest
#: ratio of the reprojection errors after and before it, and largest ratio of focal lengths that
#: count as equal. Our choice: with separate cameras, the focal lengths of fern's 20 photographs
#: agree to 0.7 %, and the ratio of the errors is 0.998.
_LEAST_SHARING, _OWN_ITERATIONS, _BETTER, _SAME_FOCAL = 3, 30, 0.97, 1.05


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
