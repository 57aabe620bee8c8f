"""Moves given poses and points to a world of their own, wherever they are in the user's.

Float32 has 7 digits: a metre of a world in UTM's or Earth's coordinates would be a few steps of it.
And training depends on the origin and the axes of the world, if little (`xrgs.splat.normalize`). So
every world of given poses is moved, in float64: the cameras' mean becomes the origin, as COLMAP
does with its own worlds, and the axes are the first camera's.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    Array = NDArray[np.float64]

#: Points that are rounded to more than this share of their distance are no points to begin with.
_MOST_ROUNDED = 1e-3


def own_world(viewmats: Mapping[int, Array]) -> tuple[dict[int, Array], Array]:
    """Move cameras to a world of their own.

    Args:
        viewmats: World to camera [4, 4], rigid, by the index of the photograph.

    Returns:
        The same in the new world, and the rigid transform [4, 4] from the given world to it.
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
    """Return the steps of points that 32 bits have rounded coarsely; None where they are fine.

    Args:
        points: Points [P, 3] in the given world.
        moved: The same in the world of `own_world`.
    """
    as_32_bits = points.astype(np.float32)
    if not len(points) or not (as_32_bits == points).all():
        return None
    step = float(np.spacing(np.abs(as_32_bits).max()))
    distance = float(np.median(np.linalg.norm(moved, axis=1)))
    return step if step > _MOST_ROUNDED * distance else None
