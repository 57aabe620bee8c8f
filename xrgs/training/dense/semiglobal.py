"""Semi-global matching [hirschmuller2008]: smooths the costs of depths along lines of pixels."""

from __future__ import annotations

import numpy as np

from xrgs.training.dense.levels import Floats

STEP = 0.015
"""P1: penalty for a depth one plane from that of the neighbouring pixel; our choice."""
JUMP = 0.2
"""P2: penalty for any larger difference; our choice."""


def smoothed(costs: Floats, backend: str = "torch") -> Floats:
    """Smooth the costs along the rows and columns of pixels, in both directions.

    Along a line, with p' the pixel before p,

        L(p, d) = C(p, d) + min(L(p', d), L(p', d - 1) + P1, L(p', d + 1) + P1, m + P2) - m

    where m is the minimum of L(p', .) over the depths.

    Returns:
        The sum of L over the four directions, [D, h, w] as `costs`.
    """
    both_ways = _native_both_ways if backend == "native" else _both_ways
    by_column = both_ways(np.ascontiguousarray(costs.transpose(2, 0, 1)))  # [w, D, h]
    by_row = both_ways(np.ascontiguousarray(costs.transpose(1, 0, 2)))  # [h, D, w]
    total: Floats = by_column.transpose(1, 2, 0) + by_row.transpose(1, 0, 2)
    return total


def _both_ways(costs: Floats) -> Floats:
    """Return forward L plus backward L along the first axis of costs [n, D, m]."""
    total = np.empty_like(costs)
    path = costs[0]
    total[0] = path
    for place in range(1, len(costs)):
        path = _next(path, costs[place])
        total[place] = path
    path = costs[-1]
    total[-1] += path
    for place in range(len(costs) - 2, -1, -1):
        path = _next(path, costs[place])
        total[place] += path
    return total


def _native_both_ways(costs: Floats) -> Floats:
    from xrgs import _native  # not built where the backend is torch

    total = np.empty_like(costs)
    _native.semiglobal_sums(costs, JUMP, STEP, total)
    return total


def _next(path: Floats, costs: Floats) -> Floats:
    """Compute L of the next pixels of m lines from L [D, m] and the next pixels' costs [D, m]."""
    least = path.min(axis=0)
    reached: Floats = np.minimum(path, least + np.float32(JUMP))
    np.minimum(reached[1:], path[:-1] + np.float32(STEP), out=reached[1:])
    np.minimum(reached[:-1], path[1:] + np.float32(STEP), out=reached[:-1])
    reached -= least
    reached += costs
    return reached


def minimum(costs: Floats) -> Floats:
    """Return the plane of each pixel's least cost [D, h, w], interpolated by a parabola.

    There are at least 3 planes; the result [h, w] is in 0..D - 1.
    """
    planes = len(costs)
    place = costs.argmin(axis=0)
    inner = np.clip(place, 1, planes - 2)
    before, at, after = (
        np.take_along_axis(costs, (inner + shift)[None], axis=0)[0] for shift in (-1, 0, 1)
    )
    bend = np.maximum(before - 2 * at + after, np.float32(1e-9))
    between = np.where(place == inner, (before - after) / (2 * bend), 0)
    result: Floats = place.astype(np.float32) + np.clip(between, -0.5, 0.5).astype(np.float32)
    return result
