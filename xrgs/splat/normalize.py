"""Bring a scene into gsplat's world: learning rates and thresholds are written for it.

The method of gsplat's `examples/datasets/normalize.py`: a similarity from the cameras (up is -y,
what they look at in the middle, the median camera at distance 1), then the principal axes of the
points (z the thinnest). All in numpy float64, as SfM's output is.

Medians are taken coordinate by coordinate and the focus from the world's origin, as gsplat does:
so the result is the same for a world of any scale, but not for any origin.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

SCALE_MARGIN = 1.1
"""gsplat's trainer multiplies the cameras' extent by this to get the scene's scale."""


@dataclass(frozen=True)
class Normalized:
    """A scene in the normalised world."""

    viewmats: Array  # [C, 4, 4] world to camera, rigid
    points: Array  # [P, 3]
    transform: Array  # [4, 4] similarity that brought the old world here
    scene_scale: float
    """1.1 x the largest distance of a camera from the mean camera position."""


def normalize_scene(viewmats: Array, points: Array) -> Normalized:
    """Normalise cameras and points together. An image rendered from either world is the same.

    Args:
        viewmats: [C, 4, 4] world to camera, rigid.
        points: [P, 3] SfM points.

    Raises:
        ValueError: no camera, fewer than 3 points, a wrong shape or a value that is not finite.
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
    moved = transform_viewmats(transform, viewmats)
    positions = camera_positions(moved)
    reach = np.linalg.norm(positions - positions.mean(axis=0), axis=1).max()
    return Normalized(
        moved, transform_points(transform, points), transform, float(reach) * SCALE_MARGIN
    )


def camera_positions(viewmats: Array) -> Array:
    """Where the cameras of viewmats [C, 4, 4] stand: [C, 3]."""
    positions: Array = -np.einsum("nji,nj->ni", viewmats[:, :3, :3], viewmats[:, :3, 3])
    return positions


def similarity_from_cameras(viewmats: Array) -> Array:
    """Similarity [4, 4] that turns the cameras' mean up axis to -y and their focus to 0.

    The focus is the median of each optical axis's nearest point to the (turned) origin, as in
    gsplat's `center_method="focus"`; the scale makes the median camera distance from it 1.
    """
    up = -viewmats[:, 1, :3].mean(axis=0)
    turn = rotation_between(up / np.linalg.norm(up), np.array([0.0, -1.0, 0.0]))
    positions = camera_positions(viewmats) @ turn.T  # [C, 3]
    forward = viewmats[:, 2, :3] @ turn.T  # [C, 3]
    nearest = positions - (forward * positions).sum(axis=1, keepdims=True) * forward
    focus = np.median(nearest, axis=0)
    distance = np.median(np.linalg.norm(positions - focus, axis=1))
    # A single camera whose axis passes through the origin's nearest point can sit on its focus.
    scale = 1.0 / distance if distance > 0 else 1.0
    similarity = np.eye(4)
    similarity[:3, :3] = scale * turn
    similarity[:3, 3] = -scale * focus
    return similarity


def rotation_between(start: Array, end: Array) -> Array:
    """The shortest rotation [3, 3] that takes unit vector `start` to unit vector `end`."""
    cosine = float(start @ end)
    if cosine <= -1.0 + 1e-12:
        # Opposite: half a turn about any axis across them.
        across = np.cross(start, np.eye(3)[np.abs(start).argmin()])
        across /= np.linalg.norm(across)
        half_turn: Array = 2.0 * np.outer(across, across) - np.eye(3)
        return half_turn
    x, y, z = np.cross(start, end)
    skew = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    rotation: Array = np.eye(3) + skew + skew @ skew / (1.0 + cosine)
    return rotation


def principal_axes(points: Array) -> Array:
    """Rigid transform [4, 4]: the median of points [P, 3] to 0, their widest axis to x, then y."""
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
    """Apply a similarity [4, 4] to points [P, 3]."""
    moved: Array = points @ transform[:3, :3].T + transform[:3, 3]
    return moved


def transform_viewmats(transform: Array, viewmats: Array) -> Array:
    """The viewmats [C, 4, 4] of the same cameras in the world that a similarity [4, 4] makes.

    They stay rigid: the world's scale goes into the translations.
    """
    scale = np.cbrt(np.linalg.det(transform[:3, :3]))
    moved: Array = viewmats @ np.linalg.inv(transform)  # old camera from the new world
    moved[:, :3] *= scale
    return moved
