"""What every format of poses is read into."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from xrgs.photos.lens import Lens

#: The fewest points: a Gaussian's first size is the distance of a point to its three nearest.
MIN_POINTS = 4
#: (the name of an image, width and height in px that its photograph is stored with) -> its camera,
#: in px of the image, and its pose, world to camera [4, 4] with OpenCV axes.
CameraOf = Callable[[str, tuple[int, int]], tuple[Lens, NDArray[np.float64]]]


@dataclass(frozen=True)
class GivenPoses:
    """The cameras and points of a file of the user's."""

    names: Sequence[str]
    """The images that have a pose, with folders and suffix as the file has them."""
    camera: CameraOf
    """Reads one camera; it raises XrgsError where that one is malformed."""
    points: NDArray[np.float64]
    """Points [P, 3]; none where the file has none."""
    colors: NDArray[np.uint8]
    """Their colours [P, 3]."""
    observed: Mapping[str, NDArray[np.intp]] = field(default_factory=dict)
    """Indices of the points that were found in each image, ascending, where they are known."""
    report: Mapping[str, Any] = field(default_factory=dict)
    """What the variant's report has beside the notes."""
    notes: Sequence[str] = ()
    """Sentences on what was taken, left out or not read."""
