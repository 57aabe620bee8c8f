"""The surfaces of a scene, as squares of nearly uniform colour at the depths of the pixels."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from xrgs.runtime.machine import single_torch_thread
from xrgs.runtime.progress import progress
from xrgs.training.dense.checks import consistent, not_seen_through, owned
from xrgs.training.dense.depths import DepthMap, choose_planes, sweep
from xrgs.training.dense.levels import Doubles, SweptView, resized
from xrgs.training.dense.quadtree import Quadtree, limit_for

_CELLS = 24
"""Number of coverage cells along the longer side of a view; our choice."""


@dataclass(frozen=True)
class Squares:
    """N squares on the surfaces of a scene."""

    points: Doubles
    """[N, 3] centres, world units."""
    colors: Doubles
    """[N, 3] in 0..1."""
    sides: Doubles
    """[N] side lengths, world units."""


def find_depths(
    views: Sequence[SweptView], points: Doubles, backend: str = "torch"
) -> dict[int, DepthMap]:
    """Sweep every view, and check its depths against those of the other views.

    Returns:
        Number of a view -> its depths. Views that can't be swept are missing.
    """
    planes = choose_planes(views, points)
    # Views run in parallel, each on one thread, so that the bits do not depend on the thread count.
    with single_torch_thread() as threads, ThreadPoolExecutor(threads) as pool:
        swept = pool.map(lambda number: sweep(views, planes[number], number, backend), planes)
        found = dict(zip(planes, progress(swept, "dense start", "view", len(planes)), strict=True))
        for check in (consistent, not_seen_through):
            passed = list(pool.map(partial(check, found), found))
            found = {
                number: replace(depths, good=good)
                for (number, depths), good in zip(found.items(), passed, strict=True)
            }
    return found


def cover(maps: Sequence[DepthMap], budget: int) -> Squares:
    """Cover the good pixels of all views, at least one, with squares, each place once.

    A place is assigned to the view with the highest sampling rate that shows it at a good pixel.
    The squares are the leaves of quadtrees, which are split where colours differ most. There are at
    most `budget`, unless the quadtrees' largest squares exceed it.
    """
    ordered = sorted(maps, key=lambda each: -each.view.photograph.sampling_rate)
    of_views = zip(ordered, owned(ordered), strict=True)
    having = [(each, pixels) for each, pixels in of_views if pixels.any()]
    cameras = [each.view.photograph.camera for each, _ in having]
    focal = [camera.numbers.intrinsics[0] for camera in cameras]
    trees = [
        Quadtree(
            each.view.photograph.image.numpy(),
            resized(pixels, camera.height, camera.width),
            # Weighted by a pixel's solid angle, so that coarse views are split too.
            weight=(max(focal) / own) ** 2,
        )
        for (each, pixels), camera, own in zip(having, cameras, focal, strict=True)
    ]
    limit = limit_for(trees, budget)
    parts = [_squares(each, tree, limit) for (each, _), tree in zip(having, trees, strict=True)]
    return Squares(*(np.concatenate(values) for values in zip(*parts, strict=True)))


def _squares(depths: DepthMap, tree: Quadtree, limit: float) -> tuple[Doubles, Doubles, Doubles]:
    """Return points, colours and sides of the leaves of a view's quadtree."""
    leaves, level, camera = tree.leaves(limit), depths.view.finest, depths.view.photograph.camera
    height, width = depths.good.shape
    down, across = height / camera.height, width / camera.width  # level px per photograph px
    row, column = (
        ((nearest + 0.5) * scale).astype(np.int64)
        for nearest, scale in zip(leaves.nearest, (down, across), strict=True)
    )
    depth = 1 / depths.inverse_depth[row, column].astype(np.float64)
    points = level.to_world(leaves.x * across, leaves.y * down, depth)
    # focal[0] / across is the focal length in px of the photograph.
    sides = np.sqrt(leaves.pixels) * depth * across / level.focal[0]
    return points, leaves.colors, sides


def share_good(views: Sequence[SweptView], maps: Sequence[DepthMap]) -> float:
    """Return the fraction of used pixels with a good depth, averaged over the views."""
    shares = (each.good.sum() / max(each.view.finest.used.sum(), 1) for each in maps)
    return float(sum(shares)) / len(views)


def share_covered(views: Sequence[SweptView], points: Doubles) -> float:
    """Return the fraction of used cells that contain a point [P, 3], averaged over the views."""
    shares = []
    for view in views:
        height, width = view.coarse.used.shape
        cell = max(height, width) / _CELLS  # px
        x, y, _ = view.coarse.project(points)
        inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)  # false for nan
        rows, columns = (int(np.ceil(size / cell)) for size in (height, width))
        covered = np.zeros((rows, columns), bool)
        covered[(y[inside] / cell).astype(np.int64), (x[inside] / cell).astype(np.int64)] = True
        row, column = np.nonzero(view.coarse.used)
        used = np.zeros_like(covered)
        used[(row / cell).astype(np.int64), (column / cell).astype(np.int64)] = True
        shares.append((covered & used).sum() / max(used.sum(), 1))
    return float(np.mean(shares))
