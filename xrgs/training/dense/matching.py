"""Compares the windows of a view with those of others, for many depths of every pixel."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from xrgs.training.dense.levels import Bools, Floats, Level

REACH = 2
"""Windows reach this many px to each side: they are 5 x 5 px."""
BEST = 4
"""A depth's score is the mean of this many other views' correlations, the highest ones, so that a
view in which something else hides the pixel does not count."""
_NOISE = np.float32(1e-5)
"""Added to the variances of the windows: about the variance of the noise of 8 bits, so that flat
windows have no correlation."""
_CHUNK = 1 << 16
"""Depths are compared for about this many pixels at once, which the processor's caches hold."""
_BEHIND = np.float32(1e-6)


class Windows:
    """An image in windows of 5 x 5 px, for its correlation with others."""

    def __init__(self, image: Floats) -> None:
        """Compute the moments of the windows.

        Args:
            image: [h, w] in 0..1.
        """
        # Differences from mid-gray, since less of the variances is then lost to rounding.
        self.image = image - np.float32(0.5)
        self.share: Floats = np.float32(1) / box_sum(np.ones_like(image))
        """1 over the number of pixels [h, w] of each window that are in the image."""
        self.mean, self.variance = self._moments(self.image)

    def zncc(self, other: Floats) -> Floats:
        """The zero-mean normalised cross-correlation with the windows of other images.

            (E[I J] - E[I] E[J]) / sqrt((Var[I] + e) (Var[J] + e)),   e = 1e-5

        where E is the mean over the pixels of a window that are in the image.

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
        """The mean and the variance, with the noise, of each window."""
        mean = box_sum(image) * self.share
        variance = box_sum(image * image) * self.share - mean * mean
        return mean, np.maximum(variance, 0) + _NOISE


def box_sum(image: Floats) -> Floats:
    """Sum images [..., h, w] over the window around each pixel; outside there are zeros."""
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
    """How badly each pixel fits at each of its inverse depths: 1 - its score, in 0..1.

    The score is the mean of the `BEST` highest correlations with other views. A correlation below 0
    counts as 0, and so does that with a view whose image the pixel is not in.

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
        _native_costs(windows, paths, inverse_depths, result)
        return result
    for part in _parts(len(inverse_depths), size[0] * size[1]):
        highest = [np.zeros_like(result[part]) for _ in range(min(BEST, len(others)))]
        for path in paths:
            image, inside = path.sample(inverse_depths[part])
            score = np.where(inside, windows.zncc(image), 0)
            for best in highest:  # each takes the score if it is higher, and passes the lower on
                lower = np.minimum(best, score)
                np.maximum(best, score, out=best)
                score = lower
        total = highest[0]
        for best in highest[1:]:
            total += best
        result[part] = 1 - total / len(highest)
    return result


def _native_costs(
    windows: Windows, paths: Sequence[_Path], inverse_depths: Floats, result: Floats
) -> None:
    """Write the costs [D, h, w] to `result`."""
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


def _parts(count: int, pixels: int) -> Iterator[slice]:
    step = max(1, _CHUNK // pixels)
    for start in range(0, count, step):
        yield slice(start, min(start + step, count))


class _Path:
    """Where the pixels of a view are in another view, by their inverse depth."""

    def __init__(self, level: Level, other: Level) -> None:
        directions, shift = level.towards(other)
        self.directions = [direction.astype(np.float32) for direction in directions]
        self.shift = shift.astype(np.float32)
        self.other = other
        # A row and a column more, so that the four neighbours of every place exist.
        self.image = np.pad(other.gray, ((0, 1), (0, 1)), mode="edge")

    def sample(self, inverse_depths: Floats) -> tuple[Floats, Bools]:
        """Sample the other image where the pixels [h, w] are at their inverse depths [d, ...].

        Returns:
            [d, h, w] the image, bilinear, and whether the pixel is in it and inside its mask.
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
    """The sample before a position on an axis, clamped to the image, and the share of the next."""
    position = np.clip(position - np.float32(0.5), 0, np.float32(size - 1))
    before = position.astype(np.int32)
    return before, position - before.astype(np.float32)
