"""Measures how finely each view samples the scene.

The sampling rate nu = focal length (px) / depth is the number of px per scene unit in which a view
shows the scene. A pixel count stands for the focal length (the paper's Camera Keychain), a distance
for the depth (its Dining Room).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from xrgs.errors import XrgsError

if TYPE_CHECKING:
    from xrgs.mixture.sfm import Reconstruction
    from xrgs.photos.lens import Lens

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

#: A view that observes fewer points takes the depth of all points inside its image instead.
_MIN_OBSERVED = 8
#: The share of the training views that see a point whose rates count as finest there; our choice.
#: One photograph by a long lens among forty is no reason to render all others larger.
_FINEST_SHARE = 0.1


@dataclass(frozen=True)
class Measures:
    """What a tagging policy may score a view by."""

    size: tuple[int, int]
    """Width and height of the photograph as it was taken, px."""
    K: Array
    """Intrinsics [3, 3] of the undistorted HR view, px; NaN where they are not known."""
    depth: float
    """Median depth of the view's points, in world units; NaN where it is not known."""


def not_placed(size: tuple[int, int]) -> Measures:
    """Return the measures of a view without a camera, of which the size alone is known."""
    return Measures(size, np.full((3, 3), np.nan), float("nan"))


def median_depth(
    points: Array, viewmat: Array, lens: Lens, observed: Sequence[int] | NDArray[np.intp] = ()
) -> float:
    """Compute the median depth of the SfM points that a view observes.

    Args:
        points: SfM points [P, 3].
        viewmat: World to camera [4, 4].
        lens: The view's camera; the undistorted image is the one that counts.
        observed: Indices of the points that SfM found in the view. Points behind the camera do not
            count. Where fewer than 8 are left, all points in front of the camera that project into
            its image are taken instead.

    Returns:
        The depth along the optical axis, in world units; NaN without a point.
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
    """Return the `median_depth` of every registered view, by index.

    A view that observes no point gets the median of the others.

    Raises:
        XrgsError: No view observes a point.
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
    """Return the sampling rate nu, px per world unit.

    Args:
        K: Intrinsics [3, 3], px. The geometric mean of both axes' focal lengths is taken.
        depth: The median depth, in world units.
    """
    return float(np.sqrt(K[0, 0] * K[1, 1]) / depth)


def relative_to_largest(values: Sequence[float]) -> list[float]:
    """Divide positive numbers by the largest of them; NaN stays NaN."""
    largest = np.nanmax(values)
    return [float(value / largest) for value in values]


def point_rates(
    points: Array, viewmat: Array, K: Array, size: tuple[int, int], used: Mask | None = None
) -> Array:
    """Compute the sampling rate of a view at each point, px per world unit.

    A view sees a point that is in front of the camera and inside the image, at a pixel that the
    mask uses. Other points that may hide it are not known.

    Args:
        points: [P, 3] in world units.
        viewmat: World to camera [4, 4].
        K: Intrinsics [3, 3], px.
        size: Width and height of the image, px.
        used: The view's mask [H, W], True for a pixel that is used; None uses all.

    Returns:
        [P] sqrt(fx fy) / z at depth z; 0 where the view does not see the point.
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
    """Compute how many times as many px a side each view needs to be as fine as the finest views.

    With r_v(p) the rate of view v at point p,

        need_v = median over the points p that v sees of r*(p) / r_v(p),

    where r*(p) is a rate that a tenth of the training views that see p reach, and at least one of
    them. Our choice: the whole measure. The maximum in place of that rate would let a single
    close-up of a large scene decide for all other views.

    Args:
        rates: `point_rates` [V, P] of all views at the same points.
        trained: [V], True for a training view.

    Returns:
        The factor of each view; 1 for a view that sees no point that a training view sees.
    """
    descending = -np.sort(-rates[trained], axis=0)
    rank = np.ceil(_FINEST_SHARE * (descending > 0).sum(axis=0)).astype(np.intp) - 1
    finest = np.take_along_axis(descending, np.maximum(rank, 0)[None], axis=0)[0]  # [P]
    needs = []
    for rate in rates:
        both = (rate > 0) & (finest > 0)
        needs.append(float(np.median(finest[both] / rate[both])) if both.any() else 1.0)
    return needs
