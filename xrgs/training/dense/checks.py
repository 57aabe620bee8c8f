"""Consistency of depths between views, and assignment of each place to one view."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from xrgs.training.dense.depths import DepthMap
from xrgs.training.dense.levels import Bools, Doubles

AGREEING = 2
"""Number of neighbours with the same depth that a good depth needs (1 if the view has only one
neighbour); our choice."""
_TOLERANCE = 1.0
"""Depths agree if their inverse depths differ by at most this many plane steps of the coarser
sweep. The other view sees through a point that is nearer than that; our choice."""


class _Comparison:
    """Compares points of one view with the depth map of another; all arrays are [P]."""

    def __init__(self, points: Doubles, step: float, other: DepthMap) -> None:
        """Project points [P, 3], world units, of a view whose planes are `step` apart."""
        x, y, depth = other.view.finest.project(points)
        height, width = other.good.shape
        inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)  # false for nan
        row, column = (np.where(inside, place, 0).astype(np.int64) for place in (y, x))
        nearer = 1 / depth - other.inverse_depth[row, column]
        known = inside & other.good[row, column]
        tolerance = _TOLERANCE * max(step, other.step)
        self.agrees = known & (np.abs(nearer) <= tolerance)
        """Whether the other view has the same depth at the point, at a good pixel."""
        self.sees_through = known & (nearer > tolerance)
        """Whether the point is in front of the other view's depth, at a good pixel."""


def good_points(depths: DepthMap) -> Doubles:
    """Return the points [P, 3] of a view's good pixels, world units, row by row."""
    row, column = np.nonzero(depths.good)
    depth = 1 / depths.inverse_depth[row, column].astype(np.float64)
    x, y = (axis.astype(np.float64) + 0.5 for axis in (column, row))
    return depths.view.finest.to_world(x, y, depth)


def consistent(maps: Mapping[int, DepthMap], number: int) -> Bools:
    """Return the good pixels [h, w] of a view whose depth agrees with `AGREEING` neighbours.

    `maps` has the depths of the views by their numbers.
    """
    own = maps[number]
    points = good_points(own)
    neighbours = [maps[n] for n in own.neighbours if n in maps]
    agreeing = np.zeros(len(points), np.int64)
    for other in neighbours:
        agreeing += _Comparison(points, own.step, other).agrees
    return _among_good(own, agreeing >= max(1, min(AGREEING, len(neighbours))))


def not_seen_through(maps: Mapping[int, DepthMap], number: int) -> Bools:
    """Return the good pixels [h, w] with more views of the same depth than that see through."""
    own = maps[number]
    points = good_points(own)
    balance = np.zeros(len(points), np.int64)
    for other in maps.values():
        if other is not own:
            compared = _Comparison(points, own.step, other)
            balance += compared.agrees
            balance -= compared.sees_through
    return _among_good(own, balance > 0)


def owned(maps: Sequence[DepthMap]) -> list[Bools]:
    """Return for each view its good pixels [h, w] that no earlier view shows."""
    result = []
    for place, own in enumerate(maps):
        points = good_points(own)
        left = np.ones(len(points), bool)
        for earlier in maps[:place]:
            left[left] = ~_Comparison(points[left], own.step, earlier).agrees
        result.append(_among_good(own, left))
    return result


def _among_good(depths: DepthMap, chosen: Bools) -> Bools:
    """Return the mask [h, w] of the good pixels that are `chosen` [P]."""
    pixels = np.zeros_like(depths.good)
    pixels[depths.good] = chosen
    return pixels
