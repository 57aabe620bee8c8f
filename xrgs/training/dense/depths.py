"""The depths of every view's pixels: a plane sweep, a refinement, and checks between the views."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import median_filter

from xrgs.training.dense.levels import Bools, Doubles, Floats, Level, SweptView
from xrgs.training.dense.matching import costs, minimum, smoothed

NEIGHBOURS = 8
"""Largest number of neighbours, the nearest cameras, that a view is compared with; our choice."""
_LEAST_PARALLAX = 0.02
"""Least distance of a neighbour, as a fraction of the median depth: nearer cameras see too little
parallax; our choice."""
_LEAST_COSINE = 0.5
"""Least cosine of the angle between the optical axes of neighbours: 60 degrees; our choice."""
_LEAST_POINTS = 8
"""A view with fewer SfM points in its image is not swept; our choice."""
_PERCENTILES = 1, 50, 99
_MARGIN = 1.25
"""Planes extend beyond the 1st and 99th percentile of the SfM points' depths by this factor; our
choice."""
_STEP = 0.35
"""Motion of the projection into a neighbour between two planes, px, median over the neighbours; our
choice."""
_PLANES = 16, 128
"""Least and largest number of planes of a sweep."""
_REACH = 3, 8
"""Least and largest number of planes on either side of a pixel's depth in a refinement."""
_REFINEMENTS = 3
"""Number of refinements; each searches around the depths of the one before; our choice."""
_WINDOW = 5
"""Side of the filters' window after each refinement, px: a median removes single wrong depths, then
a mean that stops at edges smooths."""
_LEAST_FINE = 3
"""A fine level is compared only with fine levels if this many neighbours have one."""
AGREEING = 2
"""Number of neighbours with the same depth that a good depth needs (1 if the view has only one
neighbour); our choice."""
_TOLERANCE = 1.0
"""Depths agree if their inverse depths differ by at most this many plane steps of the coarser
sweep. The other view sees through a point that is nearer than that; our choice."""


@dataclass(frozen=True)
class Planes:
    """The planes that sweep one view."""

    inverse_depths: Floats
    """[D] 1 / world units, from far to near, evenly spaced."""
    neighbours: list[int]
    """Numbers of the views to compare it with, the nearest first."""

    @property
    def step(self) -> np.float32:
        """Difference of inverse depth between two planes."""
        step: np.float32 = self.inverse_depths[1] - self.inverse_depths[0]
        return step


@dataclass(frozen=True)
class DepthMap:
    """The depths of a view's pixels."""

    view: SweptView
    inverse_depth: Floats
    """[h, w] 1 / world units, at the view's finest level."""
    good: Bools
    """[h, w] whether the pixel's depth has passed all checks so far."""
    step: float
    """Difference of inverse depth between two planes of the sweep."""
    neighbours: list[int]
    """Numbers of the views that the sweep compared."""


def choose_planes(views: Sequence[SweptView], points: Doubles) -> dict[int, Planes]:
    """Choose the planes and neighbours of each view, by the SfM points [P, 3], world units.

    Returns:
        Number of a view -> its planes. Views that can't be swept are missing: too few points are in
        their image, or they have no neighbour.
    """
    levels = [view.coarse for view in views]
    positions = np.stack([level.position for level in levels])
    axes = np.stack([level.rotation[2] for level in levels])
    chosen = {}
    for number, level in enumerate(levels):
        x, y, depth = level.project(points)
        height, width = level.gray.shape
        # False for nan.
        depths = depth[(x >= 0) & (x <= width) & (y >= 0) & (y <= height)]
        if len(depths) < _LEAST_POINTS:
            continue
        nearest, median, farthest = np.percentile(depths, _PERCENTILES, method="lower")
        distance = np.sqrt(np.square(positions - positions[number]).sum(axis=1))
        facing = (axes * axes[number]).sum(axis=1)
        able = (distance >= _LEAST_PARALLAX * median) & (facing >= _LEAST_COSINE)
        neighbours = [int(n) for n in np.argsort(distance, kind="stable") if able[n]]
        if neighbours:
            far, near = 1 / (farthest * _MARGIN), _MARGIN / nearest
            moves = _displacement(level, [levels[n] for n in neighbours[:NEIGHBOURS]], far, near)
            count = int(np.clip(np.ceil(moves / _STEP) + 1, *_PLANES))
            chosen[number] = Planes(np.linspace(far, near, count, dtype=np.float32), neighbours)
    return chosen


def _displacement(level: Level, others: Sequence[Level], far: float, near: float) -> float:
    """Return the motion of the central pixel's projection between two inverse depths, px.

    It is the upper median over the other views.
    """
    row, column = (size // 2 for size in level.gray.shape)
    moves = []
    for other in others:
        directions, shift = level.towards(other)
        (x0, y0), (x1, y1) = (
            (x / max(z, 1e-3), y / max(z, 1e-3))
            for inverse_depth in (far, near)
            for x, y, z in [
                [a[row, column] + b * inverse_depth for a, b in zip(directions, shift, strict=True)]
            ]
        )
        moves.append(float(np.hypot(x1 - x0, y1 - y0)))
    return sorted(moves)[len(moves) // 2]


def sweep(
    views: Sequence[SweptView], planes: Planes, number: int, backend: str = "torch"
) -> DepthMap:
    """Find the depths of one view, `views[number]`, by its planes; `backend` as for `costs`."""
    view, nearest = views[number], planes.neighbours[:NEIGHBOURS]
    inverse_depths = planes.inverse_depths[:, None, None]
    volume = costs(view.coarse, [views[n].coarse for n in nearest], inverse_depths, backend)
    coarse = planes.inverse_depths[0] + planes.step * minimum(smoothed(volume, backend))
    fine = _refined(view, [views[n] for n in planes.neighbours], planes, coarse, backend)
    return DepthMap(view, fine, view.finest.used, float(planes.step), nearest)


def _refined(
    view: SweptView,
    neighbours: Sequence[SweptView],
    planes: Planes,
    coarse: Floats,
    backend: str,
) -> Floats:
    """Refine the coarse level's depths `coarse` by searching around them on the finest level."""
    if view.fine is not None:
        fine = [other for other in neighbours if other.fine is not None]
        neighbours = fine if len(fine) >= _LEAST_FINE else neighbours
    level, others = view.finest, [other.finest for other in neighbours[:NEIGHBOURS]]
    far, near = planes.inverse_depths[0], planes.inverse_depths[-1]
    step = planes.step * _displacement(level, others, float(far), float(near)) / (near - far)
    reach = int(np.clip(np.ceil(step / _STEP), *_REACH))
    offsets = np.arange(-reach, reach + 1, dtype=np.float32) * (planes.step / np.float32(reach))
    depths = enlarged(coarse, *level.gray.shape)
    for _ in range(_REFINEMENTS):
        around = np.maximum(depths + offsets[:, None, None], far / 2)
        place = minimum(smoothed(costs(level, others, around, backend), backend))
        depths = np.maximum(depths + offsets[0] + (offsets[1] - offsets[0]) * place, far / 2)
        depths = evened(median_filter(depths, _WINDOW, mode="nearest"), planes.step)
    return depths


def evened(image: Floats, range_: np.float32) -> Floats:
    """Smooth an image [h, w] by the mean of each pixel's window, without blurring edges.

    Values of the window that differ by more than `range_` from the pixel's are ignored.
    """
    height, width = image.shape
    total, number = np.zeros_like(image), np.zeros_like(image)
    padded = np.pad(image, _WINDOW // 2, mode="edge")
    for row in range(_WINDOW):
        for column in range(_WINDOW):
            other = padded[row : row + height, column : column + width]
            near = np.abs(other - image) <= range_
            total += np.where(near, other, 0)
            number += near
    return total / number


def enlarged(image: Floats, height: int, width: int) -> Floats:
    """Enlarge an image [h, w] to [height, width], bilinearly."""
    for axis, new in enumerate((height, width)):
        old = image.shape[axis]
        place = np.clip((np.arange(new) + 0.5) * old / new - 0.5, 0, old - 1)
        before = place.astype(np.int64)
        share = np.expand_dims((place - before).astype(np.float32), 1 - axis)
        first, second = (np.take(image, np.minimum(before + n, old - 1), axis=axis) for n in (0, 1))
        image = first + share * (second - first)
    return image


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
