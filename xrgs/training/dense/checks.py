"""Which depths hold against those of other views, and which view has a place of the scene first."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from xrgs.training.dense.depths import DepthMap
from xrgs.training.dense.levels import Bools, Doubles

AGREEING = 2
"""A depth is good where this many neighbours have it too, or the one neighbour of the view; our
choice."""
_TOLERANCE = 1.0
"""Depths agree where their inverse depths differ by at most this many planes of the coarser sweep.
In front of that, a point is in space that the other view sees through; our choice."""


class _Comparison:
    """Points of one view in the depth map of another: all arrays are [P]."""

    def __init__(self, points: Doubles, step: float, other: DepthMap) -> None:
        """Project the points.

        Args:
            points: [P, 3] world units.
            step: The difference of inverse depth between two planes of the points' own view.
            other: The other view's depths.
        """
        x, y, depth = other.level.project(points)
        height, width = other.good.shape
        inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)  # false for nan
        row, column = (np.where(inside, place, 0).astype(np.int64) for place in (y, x))
        nearer = 1 / depth - other.inverse_depth[row, column]
        known = inside & other.good[row, column]
        tolerance = _TOLERANCE * max(step, other.step)
        self.agrees = known & (np.abs(nearer) <= tolerance)
        """Which points the other view has at the same depth, at a good pixel."""
        self.sees_through = known & (nearer > tolerance)
        """Which points are in front of what the other view has at a good pixel."""


def good_points(depths: DepthMap) -> Doubles:
    """The points [P, 3] of the good pixels of a view, world units, row by row."""
    row, column = np.nonzero(depths.good)
    depth = 1 / depths.inverse_depth[row, column].astype(np.float64)
    x, y = (axis.astype(np.float64) + 0.5 for axis in (column, row))
    return depths.level.to_world(x, y, depth)


def consistent(maps: Mapping[int, DepthMap], number: int) -> Bools:
    """Which good pixels [h, w] of a view have a depth that its neighbours have too.

    Args:
        maps: The depths by the numbers of the views.
        number: The number of the view.
    """
    own = maps[number]
    points = good_points(own)
    neighbours = [maps[n] for n in own.neighbours if n in maps]
    agreeing = np.zeros(len(points), np.int64)
    for other in neighbours:
        agreeing += _Comparison(points, own.step, other).agrees
    return _among_good(own, agreeing >= max(1, min(AGREEING, len(neighbours))))


def not_seen_through(maps: Mapping[int, DepthMap], number: int) -> Bools:
    """Which good pixels [h, w] of a view more views have at the same depth than see through.

    Args:
        maps: The depths by the numbers of the views.
        number: The number of the view.
    """
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
    """Give each place of the scene to the first view that has it at a good pixel.

    Args:
        maps: The depths of all views, those first whose pixels count first.

    Returns:
        For each view, the good pixels [h, w] that no view before it has.
    """
    result = []
    for place, own in enumerate(maps):
        points = good_points(own)
        left = np.ones(len(points), bool)
        for earlier in maps[:place]:
            left[left] = ~_Comparison(points[left], own.step, earlier).agrees
        result.append(_among_good(own, left))
    return result


def _among_good(depths: DepthMap, chosen: Bools) -> Bools:
    """The pixels [h, w] of the chosen ones [P] among the good ones."""
    pixels = np.zeros_like(depths.good)
    pixels[depths.good] = chosen
    return pixels
