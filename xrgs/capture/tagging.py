"""Measures how finely each view samples the scene, and scores views for tagging them HR or LR.

The sampling rate nu = focal length (px) / depth is the number of px per scene unit in which a view
shows the scene. A pixel count stands for the focal length (the paper's Camera Keychain), a distance
for the depth (its Dining Room).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from xrgs.capture.lens import Lens
    from xrgs.capture.sfm import Reconstruction

Array = NDArray[np.float64]

#: The values of `variant.tags` that need cameras and points, and so are applied after SfM.
DEPTH_POLICIES = ("distance", "sampling_rate")
#: A view that observes fewer points takes the depth of all points inside its image instead.
_MIN_OBSERVED = 8


def median_depth(
    points: Array, viewmat: Array, lens: Lens, observed: Sequence[int] | NDArray[np.intp] = ()
) -> float:
    """Compute the median depth of the SfM points that a view observes.

    Args:
        points: SfM points [P, 3].
        viewmat: World to camera [4, 4].
        lens: The view's camera; its distortion is ignored.
        observed: Indices of the points that SfM found in the view. Points behind the camera do not
            count. Where fewer than 8 are left, all points in front of the camera that project into
            its image are taken instead.

    Returns:
        The depth along the optical axis, in world units; NaN where there is no such point.
    """
    camera = points @ viewmat[:3, :3].T + viewmat[:3, 3]  # [P, 3]
    depth = camera[:, 2]
    own = depth[np.asarray(observed, dtype=np.intp)]
    own = own[own > 0]
    if len(own) < _MIN_OBSERVED:
        front = camera[depth > 0]
        pixels = front @ lens.K.T
        pixels = pixels[:, :2] / pixels[:, 2:]
        inside = ((pixels >= 0) & (pixels <= (lens.width, lens.height))).all(axis=1)
        own = front[inside, 2]
    return float(np.median(own)) if len(own) else float("nan")


def median_depths(model: Reconstruction) -> dict[int, float]:
    """Compute the median depth of every registered view.

    Args:
        model: What SfM found.

    Returns:
        `median_depth` by index of the view; a view that observes no point gets the median of the
        others.
    """
    depths = {
        i: median_depth(model.points, viewmat, model.lenses[i], model.observed[i])
        for i, viewmat in model.viewmats.items()
    }
    typical = float(np.nanmedian(list(depths.values()))) if depths else float("nan")
    return {i: typical if np.isnan(depth) else depth for i, depth in depths.items()}


def sampling_rate(K: Array, depth: float) -> float:
    """Compute the sampling rate nu of a view: focal length over depth.

    Args:
        K: Intrinsics [3, 3], px.
        depth: The median depth, in world units.

    Returns:
        px per world unit, with the geometric mean of both axes' focal lengths.
    """
    return float(np.sqrt(K[0, 0] * K[1, 1]) / depth)


def relative_to_largest(values: Sequence[float]) -> list[float]:
    """Divide values by the largest of them.

    Args:
        values: Positive numbers; NaN where one is not known.

    Returns:
        Numbers in (0, 1]; NaN stays NaN.
    """
    largest = np.nanmax(values)
    return [float(value / largest) for value in values]


def megapixel_scores(sizes: Sequence[tuple[int, int]]) -> list[float]:
    """Score views by the pixel counts of their photographs (the paper's Camera Keychain).

    Args:
        sizes: Width and height of each photograph as it was taken, px.

    Returns:
        Pixel counts over the largest, in (0, 1].
    """
    return relative_to_largest([float(width * height) for width, height in sizes])


def depth_scores(
    policy: str, views: int, lenses: Mapping[int, Lens], depths: Mapping[int, float]
) -> list[float]:
    """Score views by a policy that needs their depth.

    Args:
        policy: `distance` for 1 / depth (the paper's Dining Room), `sampling_rate` for focal length
            / depth.
        views: The number of views.
        lenses: The undistorted HR cameras of the registered views, by index.
        depths: Their median depths, by index.

    Returns:
        One score per view over the largest, in (0, 1]; NaN for a view that is not registered.
    """
    scores = [float("nan")] * views
    for i, lens in lenses.items():
        scores[i] = 1 / depths[i] if policy == "distance" else sampling_rate(lens.K, depths[i])
    return relative_to_largest(scores)
