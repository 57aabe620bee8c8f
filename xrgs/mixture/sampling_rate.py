"""Measures how finely each view samples the scene.

The sampling rate nu = focal length (px) / depth is the number of px per world unit at which a view
shows the scene. Two scenes of the paper use a proxy: Camera Keychain the pixel count for the focal
length, Dining Room the distance for the depth.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from xrgs.errors import XrgsError
from xrgs.mixture.views import Reconstruction
from xrgs.photos.lens import Lens

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

#: Least number of observed points for a view's depth; with fewer, all points in its image count.
_MIN_OBSERVED = 8
#: Fraction of the training views at a point that count as the finest there; our choice. So a single
#: photograph by a long lens among forty does not make all others be rendered larger.
_FINEST_SHARE = 0.1


@dataclass(frozen=True)
class Measures:
    """Properties of a view for the scores of tagging policies."""

    size: tuple[int, int]
    """Width and height of the original photograph, px."""
    K: Array
    """Intrinsics [3, 3] of the undistorted HR view, px; NaN if unknown."""
    depth: float
    """Median depth of the view's points, world units; NaN if unknown."""


def not_placed(size: tuple[int, int]) -> Measures:
    """Return the measures of a view without a camera: only the size is known."""
    return Measures(size, np.full((3, 3), np.nan), float("nan"))


def median_depth(
    points: Array, viewmat: Array, lens: Lens, observed: Sequence[int] | NDArray[np.intp] = ()
) -> float:
    """Compute the median depth of the SfM points [P, 3] that a view observes.

    Of the points that SfM `observed` in the view, those behind the camera are ignored. If fewer
    than 8 remain, all points in front of the camera that project into the undistorted image are
    used instead.

    Returns:
        The depth along the optical axis, world units; NaN without points.
    """
    camera = points @ viewmat[:3, :3].T + viewmat[:3, 3]  # [P, 3]
    depth = camera[:, 2]
    own = depth[np.asarray(observed, dtype=np.intp)]
    own = own[own > 0]
    if len(own) < _MIN_OBSERVED:
        front = camera[depth > 0]
        pixels = front @ lens.undistorted().K.T
        pixels = pixels[:, :2] / pixels[:, 2:]
        inside = ((pixels >= 0) & (pixels <= (lens.width, lens.height))).all(axis=1)
        own = front[inside, 2]
    return float(np.median(own)) if len(own) else float("nan")


def median_depths(model: Reconstruction) -> dict[int, float]:
    """Return index -> `median_depth`, of every registered view.

    Views without points get the median of the other views; XrgsError if no view observes a point.
    """
    depths = {
        i: median_depth(model.points, viewmat, model.lenses[i], model.observed[i])
        for i, viewmat in model.viewmats.items()
    }
    if np.isnan(list(depths.values())).all():
        raise XrgsError(
            "none of the points is in front of a camera and inside its image: poses and points "
            "must be of one world, and the poses must have the axes of their file format"
        )
    typical = float(np.nanmedian(list(depths.values())))
    return {i: typical if np.isnan(depth) else depth for i, depth in depths.items()}


def sampling_rate(K: Array, depth: float) -> float:
    """Return the sampling rate nu, px per world unit, of intrinsics [3, 3] and a median depth.

    The focal length is the geometric mean over both axes.
    """
    return float(np.sqrt(K[0, 0] * K[1, 1]) / depth)


def relative_to_largest(values: Sequence[float]) -> list[float]:
    """Divide positive numbers by the largest number; NaN stays NaN."""
    largest = np.nanmax(values)
    return [float(value / largest) for value in values]


def point_rates(
    points: Array, viewmat: Array, K: Array, size: tuple[int, int], used: Mask | None = None
) -> Array:
    """Compute the sampling rate of a view at each point, px per world unit.

    A view sees a point if it is in front of the camera and projects into the image, to a used
    pixel. Occlusion is ignored.

    Args:
        points: [P, 3] in world units.
        viewmat: World to camera [4, 4].
        K: Intrinsics [3, 3], px.
        size: Width and height of the image, px.
        used: The view's mask [H, W], True for a used pixel; None uses all.

    Returns:
        [P] sqrt(fx fy) / z at depth z; 0 if the view does not see the point.
    """
    camera = points @ viewmat[:3, :3].T + viewmat[:3, 3]  # [P, 3]
    rates = np.zeros(len(points))
    front = np.flatnonzero(camera[:, 2] > 0)
    pixels = camera[front] @ K.T
    pixels = pixels[:, :2] / pixels[:, 2:]
    inside = np.flatnonzero(((pixels >= 0) & (pixels < size)).all(axis=1))
    if used is not None:
        column, row = pixels[inside].astype(np.intp).T
        inside = inside[used[row, column]]
    seen = front[inside]
    rates[seen] = np.sqrt(K[0, 0] * K[1, 1]) / camera[seen, 2]
    return rates


def needed_factors(rates: Array, trained: Mask) -> list[float]:
    """Compute the factor of width and height at which each view would be as fine as the finest.

    With r_v(p) the rate of view v at point p,

        need_v = median over the points p that v sees of r*(p) / r_v(p),

    where r*(p) is the rate that a tenth of the training views that see p reach or exceed, at least
    one view. Our choice: the whole measure. With the maximum instead, a single close-up of a large
    scene would decide for all other views. A view that shares no point with a training view has 1.

    Args:
        rates: `point_rates` [V, P] of all views at the same points.
        trained: [V] bool, True for a training view.
    """
    descending = -np.sort(-rates[trained], axis=0)
    rank = np.ceil(_FINEST_SHARE * (descending > 0).sum(axis=0)).astype(np.intp) - 1
    finest = np.take_along_axis(descending, np.maximum(rank, 0)[None], axis=0)[0]  # [P]
    needs = []
    for rate in rates:
        both = (rate > 0) & (finest > 0)
        needs.append(float(np.median(finest[both] / rate[both])) if both.any() else 1.0)
    return needs
