"""Normalisation of a scene's world, which learning rates and thresholds assume.

The method of gsplat's `examples/datasets/normalize.py`: a similarity from the cameras (up is -y,
the point they look at is the origin, their median distance from it is 1), then a rotation to the
principal axes of the points (z is the thinnest). All arrays are float64, as the output of SfM.

As in gsplat, medians are taken coordinate by coordinate, and the focus is the point of each optical
axis nearest to the world's origin. So the result depends on the world's origin, not on its scale.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

SCALE_MARGIN = 1.1
"""The scene's scale is the extent of the cameras times this factor, as in gsplat's trainer."""


@dataclass(frozen=True)
class NormalizedScene:
    """A scene in the normalised world."""

    viewmats: Array  # [C, 4, 4] world to camera, rigid
    points: Array  # [P, 3]
    transform: Array  # [4, 4] similarity from the old world to the normalised one
    scene_scale: float
    """1.1 times the largest distance of a camera from the mean of the camera positions."""


def normalize_scene(viewmats: Array, points: Array) -> NormalizedScene:
    """Normalise cameras and points together, so that the cameras' images stay the same.

    Args:
        viewmats: [C, 4, 4] world to camera, rigid.
        points: [P, 3] SfM points.

    Returns:
        The scene in the normalised world.

    Raises:
        ValueError: There is no camera, there are fewer than 3 points, or an array has the wrong
            shape or a value that is not finite.
    """
    for name, value, shape in (("viewmats", viewmats, (4, 4)), ("points", points, (3,))):
        if value.shape[1:] != shape or not np.isfinite(value).all():
            raise ValueError(f"{name} must be finite [n, {shape}], got {list(value.shape)}")
    if len(viewmats) < 1 or len(points) < 3:
        raise ValueError(
            f"1 camera and 3 points are needed, got {len(viewmats)} viewmats, {len(points)} points"
        )
    similarity = similarity_from_cameras(viewmats)
    axes = principal_axes(transform_points(similarity, points))
    transform = axes @ similarity
    normalized = transform_viewmats(transform, viewmats)  # [C, 4, 4]
    positions = camera_positions(normalized)  # [C, 3]
    extent = np.linalg.norm(positions - positions.mean(axis=0), axis=1).max()
    return NormalizedScene(
        normalized, transform_points(transform, points), transform, float(extent) * SCALE_MARGIN
    )


def camera_positions(viewmats: Array) -> Array:
    """Return the centres [C, 3] of cameras with rigid viewmats [C, 4, 4]."""
    positions: Array = -np.einsum("nji,nj->ni", viewmats[:, :3, :3], viewmats[:, :3, 3])
    return positions


def similarity_from_cameras(viewmats: Array) -> Array:
    """Return the similarity that turns the cameras' mean up axis to -y and moves their focus to 0.

    Each camera's point is the one on its optical axis nearest to the origin, after the turn. The
    focus is the median of these points, as in gsplat's `center_method="focus"`. The median distance
    of the cameras from the focus becomes 1. Viewmats are [C, 4, 4], the similarity is [4, 4] from
    the old world to the new one.
    """
    up = -viewmats[:, 1, :3].mean(axis=0)
    turn = rotation_between(up / np.linalg.norm(up), np.array([0.0, -1.0, 0.0]))
    positions = camera_positions(viewmats) @ turn.T  # [C, 3]
    forward = viewmats[:, 2, :3] @ turn.T  # [C, 3]
    nearest = positions - (forward * positions).sum(axis=1, keepdims=True) * forward
    focus = np.median(nearest, axis=0)
    distance = np.median(np.linalg.norm(positions - focus, axis=1))
    # The distance of a single camera may be 0.
    scale = 1.0 / distance if distance > 0 else 1.0
    similarity = np.eye(4)
    similarity[:3, :3] = scale * turn
    similarity[:3, 3] = -scale * focus
    return similarity


def rotation_between(start: Array, end: Array) -> Array:
    """Return the shortest rotation R [3, 3] between unit vectors [3]: R start = end."""
    cosine = float(start @ end)
    if cosine <= -1.0 + 1e-12:
        # Opposite vectors: half a turn about any axis perpendicular to them.
        axis = np.cross(start, np.eye(3)[np.abs(start).argmin()])
        axis /= np.linalg.norm(axis)
        half_turn: Array = 2.0 * np.outer(axis, axis) - np.eye(3)
        return half_turn
    x, y, z = np.cross(start, end)
    skew = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    rotation: Array = np.eye(3) + skew + skew @ skew / (1.0 + cosine)
    return rotation


def principal_axes(points: Array) -> Array:
    """Return the rigid transform [4, 4] that aligns points [P, 3] with their principal axes.

    The median moves to 0, the axis of the largest variance to x, that of the smallest to z.
    """
    centre = np.median(points, axis=0)
    _, vectors = np.linalg.eigh(np.cov(points - centre, rowvar=False))
    rotation = vectors[:, ::-1].T  # eigh's eigenvalues ascend
    if np.linalg.det(rotation) < 0:
        rotation = rotation * np.array([[-1.0], [1.0], [1.0]])
    transform = np.eye(4)
    transform[:3, :3] = rotation
    transform[:3, 3] = -rotation @ centre
    return transform


def transform_points(transform: Array, points: Array) -> Array:
    """Apply a similarity [4, 4] to points [P, 3]: [P, 3]."""
    transformed: Array = points @ transform[:3, :3].T + transform[:3, 3]
    return transformed


def transform_viewmats(transform: Array, viewmats: Array) -> Array:
    """Return the viewmats [C, 4, 4] of the same cameras in a world transformed by a similarity.

    The viewmats stay rigid: the scale of the transform goes into the translations.
    """
    scale = np.cbrt(np.linalg.det(transform[:3, :3]))
    transformed: Array = viewmats @ np.linalg.inv(transform)  # new world to old camera
    transformed[:, :3] *= scale
    return transformed
