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
    from xrgs.capture.lens import Lens
    from xrgs.capture.sfm import Reconstruction

Array = NDArray[np.float64]

#: A view that observes fewer points takes the depth of all points inside its image instead.
_MIN_OBSERVED = 8


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
