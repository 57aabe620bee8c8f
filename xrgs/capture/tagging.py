"""How finely each view samples the scene, and by which measure of it views are tagged HR or LR.

The rate nu = focal length (px) / depth is the px per scene unit that a view has of what it sees. A
pixel count stands for its focal length (the paper's Camera Keychain), a distance for its depth (its
Dining Room).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from xrgs.capture.images import Lens
    from xrgs.capture.sfm import Reconstruction

Array = NDArray[np.float64]

#: Policies that need cameras and points, and so come after SfM.
NEED_DEPTH = ("distance", "sampling_rate")
#: A view with fewer points of its own takes the depth of all that fall inside its image.
_FEW_POINTS = 8


def median_depth(
    points: Array, viewmat: Array, lens: Lens, tracked: Sequence[int] | NDArray[np.intp] = ()
) -> float:
    """Median depth of the SfM points that a view sees, world units; NaN where it sees none.

    Args:
        points: [P, 3].
        viewmat: [4, 4] world to camera.
        lens: The view's camera; its distortion is left out.
        tracked: Indices of the points found in the view. Where these are fewer than 8, all points
            in front of it that fall inside its image are taken.
    """
    camera = points @ viewmat[:3, :3].T + viewmat[:3, 3]
    depth = camera[:, 2]
    own = depth[np.asarray(tracked, dtype=np.intp)]
    own = own[own > 0]
    if len(own) < _FEW_POINTS:
        front = camera[depth > 0]
        pixels = front @ lens.K.T
        pixels = pixels[:, :2] / pixels[:, 2:]
        inside = ((pixels >= 0) & (pixels <= (lens.width, lens.height))).all(axis=1)
        own = front[inside, 2]
    return float(np.median(own)) if len(own) else float("nan")


def depths(model: Reconstruction) -> dict[int, float]:
    """`median_depth` of every placed view; the scene's own where a view sees no point."""
    found = {
        i: median_depth(model.points, viewmat, model.lenses[i], model.tracked[i])
        for i, viewmat in model.viewmats.items()
    }
    usual = float(np.nanmedian(list(found.values()))) if found else float("nan")
    return {i: usual if np.isnan(depth) else depth for i, depth in found.items()}


def rate(K: Array, depth: float) -> float:
    """Px per scene unit at that depth: the focal length (geometric mean of both axes) over it."""
    return float(np.sqrt(K[0, 0] * K[1, 1]) / depth)


def of_best(values: Sequence[float]) -> list[float]:
    """Each as a share of the largest; NaN stays NaN."""
    best = np.nanmax(values)
    return [float(value / best) for value in values]


def megapixels(sizes: Sequence[tuple[int, int]]) -> list[float]:
    """Pixel counts of the photographs as they were taken, as shares of the largest."""
    return of_best([float(width * height) for width, height in sizes])


def by_depth(
    policy: str, views: int, lenses: Mapping[int, Lens], depth: Mapping[int, float]
) -> list[float]:
    """A value in 0..1 for each of `views`, 1 for the best, NaN for those not placed.

    Args:
        policy: `distance`: 1 / depth. `sampling_rate`: focal length over depth.
        views: How many photographs there are.
        lenses: Of the undegraded views placed.
        depth: Of the same.
    """
    values = [float("nan")] * views
    for i, lens in lenses.items():
        values[i] = 1 / depth[i] if policy == "distance" else rate(lens.K, depth[i])
    return of_best(values)
