"""The costs of depths: windows of a view compared with those of other views, then smoothed.

The smoothing is semi-global matching [hirschmuller2008], along lines of pixels.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from xrgs.training.dense.levels import Bools, Floats, Level

REACH = 2
"""Half size of a window, px: windows are 5 x 5 px."""
BEST = 4
"""Number of highest correlations with other views whose mean is a depth's score, so that views with
an occlusion do not count."""
_NOISE = np.float32(1e-5)
"""Added to the variances of the windows, so that flat windows have no correlation: about the
variance of 8-bit noise."""
_CHUNK = 1 << 16
"""Number of (pixel, depth) pairs that are compared at once, so that they fit in the processor's
caches."""
_BEHIND = np.float32(1e-6)
STEP = 0.015
"""P1: penalty for a depth one plane from that of the neighbouring pixel; our choice."""
JUMP = 0.2
"""P2: penalty for any larger difference; our choice."""


class Windows:
    """The 5 x 5 px windows of an image, for correlation with those of other images."""

    def __init__(self, image: Floats) -> None:
        """Compute the moments of the windows of an image [h, w] in 0..1."""
        # Centred on mid-gray, which reduces rounding errors of the variances.
        self.image = image - np.float32(0.5)
        self.share: Floats = np.float32(1) / box_sum(np.ones_like(image))
        """[h, w] 1 over the number of the window's pixels that are inside the image."""
        self.mean, self.variance = self._moments(self.image)

    def zncc(self, other: Floats) -> Floats:
        """Return the zero-mean normalised cross-correlation with the windows of other images.

            (E[I J] - E[I] E[J]) / sqrt((Var[I] + e) (Var[J] + e)),   e = 1e-5

        where E is the mean over the window's pixels inside the image.

        Args:
            other: Images J [..., h, w] in 0..1.

        Returns:
            [..., h, w] in -1..1.
        """
        other = other - np.float32(0.5)
        mean, variance = self._moments(other)
        covariance = box_sum(self.image * other) * self.share - self.mean * mean
        correlation: Floats = covariance / np.sqrt(self.variance * variance)
        return correlation

    def _moments(self, image: Floats) -> tuple[Floats, Floats]:
        """Return the mean of each window, and its variance plus `_NOISE`."""
        mean = box_sum(image) * self.share
        variance = box_sum(image * image) * self.share - mean * mean
        return mean, np.maximum(variance, 0) + _NOISE


def box_sum(image: Floats) -> Floats:
    """Sum images [..., h, w] over the window around each pixel, padded with zeros."""
    across = image.copy()
    for shift in range(1, REACH + 1):
        across[..., shift:] += image[..., :-shift]
        across[..., :-shift] += image[..., shift:]
    both = across.copy()
    for shift in range(1, REACH + 1):
        both[..., shift:, :] += across[..., :-shift, :]
        both[..., :-shift, :] += across[..., shift:, :]
    return both


def costs(
    level: Level, others: Sequence[Level], inverse_depths: Floats, backend: str = "torch"
) -> Floats:
    """Compute the matching cost of each pixel at each of its inverse depths: 1 - score, in 0..1.

    The score is the mean of the `BEST` highest correlations with other views. A correlation is 0 if
    it is negative, or if the pixel projects outside the other view.

    Args:
        level: The view, [h, w].
        others: Other views.
        inverse_depths: [D, h, w] or [D, 1, 1], 1 / world units.
        backend: `native` for the compiled kernels, which give the same bits; else numpy.

    Returns:
        [D, h, w]
    """
    size = level.gray.shape
    windows, paths = Windows(level.gray), [_Path(level, other) for other in others]
    result = np.empty((len(inverse_depths), *size), np.float32)
    if backend == "native":
        from xrgs import _native  # not built where the backend is torch

        everywhere = np.empty((0, 0), bool)
        _native.plane_sweep_costs(
            [windows.image, windows.share, windows.mean, windows.variance],
            [np.stack(path.directions) for path in paths],
            [path.shift for path in paths],
            [path.image for path in paths],
            [everywhere if path.other.used.all() else path.other.used for path in paths],
            inverse_depths,
            min(BEST, len(paths)),
            float(_NOISE),
            float(_BEHIND),
            result,
        )
        return result
    step = max(1, _CHUNK // (size[0] * size[1]))
    for start in range(0, len(inverse_depths), step):
        part = slice(start, start + step)
        highest = [np.zeros_like(result[part]) for _ in range(min(BEST, len(others)))]
        for path in paths:
            image, inside = path.sample(inverse_depths[part])
            score = np.where(inside, windows.zncc(image), 0)
            for best in highest:  # insert the score into the sorted highest scores
                lower = np.minimum(best, score)
                np.maximum(best, score, out=best)
                score = lower
        result[part] = 1 - sum(highest[1:], highest[0]) / len(highest)
    return result


class _Path:
    """Samples another view at the projections of a view's pixels."""

    def __init__(self, level: Level, other: Level) -> None:
        directions, shift = level.towards(other)
        self.directions = [direction.astype(np.float32) for direction in directions]
        self.shift = shift.astype(np.float32)
        self.other = other
        # Padded by a row and a column, so that bilinear sampling has four neighbours everywhere.
        self.image = np.pad(other.gray, ((0, 1), (0, 1)), mode="edge")

    def sample(self, inverse_depths: Floats) -> tuple[Floats, Bools]:
        """Sample the other view at the projections of the pixels at inverse depths [d, ...].

        Returns:
            [d, h, w] bilinear samples, and whether the projection is inside image and mask.
        """
        height, width = self.other.gray.shape
        x, y, z = (
            direction + shift * inverse_depths
            for direction, shift in zip(self.directions, self.shift, strict=True)
        )
        inside = z > _BEHIND
        np.maximum(z, _BEHIND, out=z)
        x, y = x / z, y / z
        inside &= (x >= 0) & (x <= width) & (y >= 0) & (y <= height)
        (column, right), (row, down) = _place(x, width), _place(y, height)
        index = row * (width + 1) + column
        corners = [
            np.take(self.image, index + offset, mode="clip")  # of the flat image
            for offset in (0, 1, width + 1, width + 2)
        ]
        top = corners[0] + right * (corners[1] - corners[0])
        bottom = corners[2] + right * (corners[3] - corners[2])
        if not self.other.used.all():
            nearest = [np.minimum(p.astype(np.int32), n - 1) for p, n in ((x, width), (y, height))]
            inside &= self.other.used[np.maximum(nearest[1], 0), np.maximum(nearest[0], 0)]
        return top + down * (bottom - top), inside


def _place(position: Floats, size: int) -> tuple[np.ndarray, Floats]:
    """Return the index of the sample before a position (clamped), and the weight of the next."""
    position = np.clip(position - np.float32(0.5), 0, np.float32(size - 1))
    before = position.astype(np.int32)
    return before, position - before.astype(np.float32)


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
