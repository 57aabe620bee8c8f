"""Paths of cameras through a scene, fitted to the cameras of its photographs.

All computations are in float64, in the normalised world of `xrgs.splat.normalize`. Its unit is the
median distance of the cameras from the point that they look at. Cameras have OpenCV axes. A path is
[views, 4, 4], world to camera.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import PchipInterpolator
from scipy.spatial.transform import Rotation, Slerp

from xrgs.errors import XrgsError
from xrgs.splat.normalize import camera_positions

Array = NDArray[np.float64]

#: The weight of the points' depth in `look_at_point`, relative to the distances from the optical
#: axes: for axes 6 degrees apart both count the same. Our choice.
_DEPTH_WEIGHT = 0.01
#: Cameras surround the focus if no gap between them is as wide as this, degrees. Our choice.
_LARGEST_GAP = 90.0
#: Cameras face one way if the mean of their viewing directions is at least this long, 0 to 1.
_MIN_FACING = 0.5
#: LLFF's spiral: the percentile of the cameras' offsets that is its radius; the percentiles of the
#: points' depths that are the near and far bound, factors of the two, weight of the near one; the
#: number of turns, and of oscillations along the optical axis for each turn.
_RADIUS_PERCENTILE, _DEPTH_PERCENTILES = 90.0, (0.1, 99.9)
_NEAR_FACTOR, _FAR_FACTOR, _NEAR_WEIGHT = 0.9, 5.0, 0.25
_TURNS, _AXIAL_RATE = 2, 0.5
#: Frames between two cameras of the path `training`. Our choice.
_FRAMES_BETWEEN = 10
#: How many cameras of an orbit `default_path` tests, and the angle up to which a training camera
#: looks the same way as one of them, degrees. Our choice.
_PROBES, _SAME_WAY = 36, 60.0


@dataclass(frozen=True)
class Poses:
    """The cameras to which a path is fitted, and the SfM points."""

    train: Array
    """[C, 4, 4] world to camera, of the training views; at least one."""
    test: Array
    """[T, 4, 4] world to camera, of the test views in their order; at least one."""
    points: Array
    """[P, 3] SfM points, world units; may be empty."""


def orbit(poses: Poses, views: int) -> Array:
    """Move on a circle around the point that the training cameras look at, and look at it.

    The circle is level, at the median height and the median distance of the cameras. If they
    surround the point, the circle is closed. If they leave a gap of more than 90 degrees, as in a
    forward-facing scene, the path swings to and fro over their arc, since the scene was not
    photographed from elsewhere. The path can be repeated without a jump.
    """
    focus, up = look_at_point(poses), up_direction(poses)
    first = _perpendicular(up)
    second = np.cross(up, first)
    offsets = camera_positions(poses.train) - focus  # [C, 3]
    across, along = offsets @ first, offsets @ second
    radius, height = np.median(np.hypot(across, along)), np.median(offsets @ up)
    start, arc = _widest_arc(np.arctan2(along, across))
    phase = np.arange(views) / views
    if 2 * np.pi - arc < np.radians(_LARGEST_GAP):
        angles = start + 2 * np.pi * phase
    else:
        angles = start + arc * (1 + np.sin(2 * np.pi * phase)) / 2
    circle = np.cos(angles)[:, None] * first + np.sin(angles)[:, None] * second
    positions = focus + radius * circle + height * up
    return np.stack([_look_at(position, focus - position, up) for position in positions])


def spiral(poses: Poses, views: int) -> Array:
    """Move on LLFF's spiral around the mean training camera, and look at one point.

    As `render_path_spiral` of [mildenhall2019], it makes two turns, and can be repeated without a
    jump. Their radii along the axes of the mean camera are the 90th percentiles of the cameras'
    offsets. All cameras look at one point on the mean camera's axis, at the harmonic mean of 0.9
    times the nearest and 5 times the farthest depth of the points, with weights 1/4 and 3/4.
    XrgsError says that the cameras don't face one way.
    """
    directions = poses.train[:, 2, :3]
    forward = directions.mean(axis=0)
    if np.linalg.norm(forward) < _MIN_FACING:
        raise XrgsError("path=spiral: the cameras don't face one way; take --path orbit")
    positions, up = camera_positions(poses.train), up_direction(poses)
    centre = positions.mean(axis=0)
    mean_camera = _look_at(centre, forward, up)
    rotation = mean_camera[:3, :3]  # its rows are the axes right, down, forward
    offsets = (positions - centre) @ rotation.T  # [C, 3]
    radii = np.percentile(np.abs(offsets), _RADIUS_PERCENTILE, axis=0)
    near, far = np.percentile(_depths(poses), _DEPTH_PERCENTILES)
    depth = 1 / (_NEAR_WEIGHT / (_NEAR_FACTOR * near) + (1 - _NEAR_WEIGHT) / (_FAR_FACTOR * far))
    target = centre + depth * rotation[2]
    angles = 2 * np.pi * _TURNS * np.arange(views) / views
    # LLFF has minus signs here: its axes point up and backward, ours down and forward.
    turns = np.stack([np.cos(angles), np.sin(angles), np.sin(_AXIAL_RATE * angles)], axis=1)
    places = centre + (turns * radii) @ rotation
    return np.stack([_look_at(place, target - place, up) for place in places])


def through_test_views(poses: Poses, views: int) -> Array:
    """Move through the test cameras in their order, at equal numbers of steps between two.

    Positions are interpolated by cubic Hermite polynomials that don't overshoot (PCHIP), rotations
    at constant angular velocity. The first camera is the first test view, the last one the last.
    """
    return _through(poses.test, views)


def through_training_views(poses: Poses, views: int) -> Array:
    """Move along the training cameras in their order, from the first to the last.

    It passes through evenly chosen cameras, one for every ten frames: through all of many cameras
    it would shake. In between it is interpolated as in `through_test_views`.
    """
    last = len(poses.train) - 1
    count = min(last + 1, max(2, 1 + views // _FRAMES_BETWEEN))
    return _through(poses.train[np.linspace(0, last, count).round().astype(int)], views)


def _through(viewmats: Array, views: int) -> Array:
    """Move through cameras [C, 4, 4] in their order, at equal numbers of steps between two."""
    count = len(viewmats)
    if count == 1:
        return np.repeat(viewmats, views, axis=0)
    keys, times = np.arange(count), np.linspace(0, count - 1, views)
    positions = PchipInterpolator(keys, camera_positions(viewmats))(times)  # [views, 3]
    rotations = Slerp(keys, Rotation.from_matrix(viewmats[:, :3, :3]))(times).as_matrix()
    return _viewmats(rotations, positions)


def default_path(poses: Poses) -> str:
    """Return `orbit`, or `training` if an orbit would leave the space that the cameras see.

    An orbit stays in that space if each of its cameras has a training camera that is nearer to it
    than the focus is, and looks the same way to 60 degrees. That holds around an object, and on the
    arc in front of a forward-facing scene. In a scene seen from inside, the training cameras look
    outwards and an orbit looks inwards.
    """
    path = orbit(poses, _PROBES)
    places, focus = camera_positions(path), look_at_point(poses)
    apart = np.linalg.norm(places[:, None] - camera_positions(poses.train), axis=2)  # [P, C]
    near = apart < np.linalg.norm(places - focus, axis=1)[:, None]
    alike = path[:, 2, :3] @ poses.train[:, 2, :3].T > np.cos(np.radians(_SAME_WAY))
    return "orbit" if (near & alike).any(axis=1).all() else "training"


PATHS: dict[str, Callable[[Poses, int], Array]] = {
    "orbit": orbit,
    "training": through_training_views,
    "spiral": spiral,
    "test": through_test_views,
}
"""Name of a path -> the function that computes it."""


def look_at_point(poses: Poses) -> Array:
    """Return the point that the training cameras look at.

    It is the point [3] of least squared distance from the optical axes, and, with a small weight,
    from the points on the axes at the median depth of the SfM points. The second part matters if
    the axes are nearly parallel, and so don't fix the depth.
    """
    positions, forward = camera_positions(poses.train), poses.train[:, 2, :3]
    targets = positions + np.median(_depths(poses)) * forward  # [C, 3]
    away = np.eye(3) - forward[:, :, None] * forward[:, None, :]  # [C, 3, 3] off the axis
    matrix = away.sum(axis=0) + _DEPTH_WEIGHT * len(forward) * np.eye(3)
    vector = np.einsum("cij,cj->i", away, positions) + _DEPTH_WEIGHT * targets.sum(axis=0)
    focus: Array = np.linalg.solve(matrix, vector)
    return focus


def up_direction(poses: Poses) -> Array:
    """Return the mean up direction of the training cameras' images, a unit vector [3]."""
    up = -poses.train[:, 1, :3].mean(axis=0)
    return np.asarray(up / np.linalg.norm(up))


def _depths(poses: Poses) -> Array:
    """Return the positive depths of the points in all training cameras, [N]; [1] if none is."""
    viewmats = poses.train
    depths = (poses.points @ viewmats[:, 2, :3].T + viewmats[:, 2, 3]).ravel()  # [P C]
    in_front: Array = depths[depths > 0]
    return in_front if len(in_front) else np.ones(1)


def _perpendicular(axis: Array) -> Array:
    """Return a unit vector [3] at a right angle to a unit vector."""
    vector = np.cross(axis, np.eye(3)[np.abs(axis).argmin()])
    return np.asarray(vector / np.linalg.norm(vector))


def _widest_arc(angles: Array) -> tuple[float, float]:
    """Return start and length, radians, of the arc outside the largest gap between angles."""
    ordered = np.sort(angles % (2 * np.pi))
    gaps = np.diff(ordered, append=ordered[0] + 2 * np.pi)
    largest = int(gaps.argmax())
    start = ordered[(largest + 1) % len(ordered)]
    return float(start), float(2 * np.pi - gaps[largest])


def _look_at(position: Array, forward: Array, up: Array) -> Array:
    """Return the viewmat [4, 4] of a camera from its position and viewing direction."""
    right = np.cross(forward, up)
    axes = np.stack([right, np.cross(forward, right), forward])
    rotation = axes / np.linalg.norm(axes, axis=1, keepdims=True)
    viewmat: Array = _viewmats(rotation[None], position[None])[0]
    return viewmat


def _viewmats(rotations: Array, positions: Array) -> Array:
    """Return viewmats [n, 4, 4] from world-to-camera rotations [n, 3, 3] and positions [n, 3]."""
    viewmats = np.repeat(np.eye(4)[None], len(rotations), axis=0)
    viewmats[:, :3, :3] = rotations
    viewmats[:, :3, 3] = -np.einsum("nij,nj->ni", rotations, positions)
    return viewmats
