"""Moves given poses and points to a standard world, near the origin.

In UTM or Earth coordinates, a metre would be only a few steps of float32, which has 7 digits.
Training also depends slightly on the origin and axes of the world (`xrgs.splat.normalize`). So all
given poses are moved, in float64: the mean of the cameras becomes the origin, as in COLMAP's
models, and the axes are those of the first camera.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    Array = NDArray[np.float64]

#: Largest rounding of points relative to their distances; coarser points are not used.
_MOST_ROUNDED = 1e-3


def own_world(viewmats: Mapping[int, Array]) -> tuple[dict[int, Array], Array]:
    """Move rigid cameras, world to camera [4, 4], to the standard world.

    Returns:
        The viewmats in the new world, and the rigid transform [4, 4] from the given world to it.
    """
    R = np.stack([matrix[:3, :3] for matrix in viewmats.values()])
    t = np.stack([matrix[:3, 3] for matrix in viewmats.values()])
    mean = -np.einsum("nji,nj->ni", R, t).mean(axis=0)
    axes = viewmats[min(viewmats)][:3, :3]
    moved = {}
    for i, matrix in viewmats.items():
        moved[i] = np.eye(4)
        moved[i][:3, :3] = matrix[:3, :3] @ axes.T
        moved[i][:3, 3] = matrix[:3, :3] @ mean + matrix[:3, 3]
    world = np.eye(4)
    world[:3, :3], world[:3, 3] = axes, -axes @ mean
    return moved, world


def moved_points(points: Array, world: Array) -> Array:
    """Move points [P, 3] to the world of `own_world`."""
    axes = world[:3, :3]
    moved: Array = (points + axes.T @ world[:3, 3]) @ axes.T
    return moved


def rounding(points: Array, moved: Array) -> float | None:
    """Return the size of float32's rounding steps if it is too coarse for the points, else None.

    `points` [P, 3] are in the given world, and `moved` in the world of `own_world`.
    """
    as_32_bits = points.astype(np.float32)
    if not len(points) or not (as_32_bits == points).all():
        return None
    step = float(np.spacing(np.abs(as_32_bits).max()))
    distance = float(np.median(np.linalg.norm(moved, axis=1)))
    return step if step > _MOST_ROUNDED * distance else None
