"""The result of reading poses, for all formats."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from xrgs.photos.lens import Lens

#: Least number of points, since the initial scale of a Gaussian needs its three nearest points.
MIN_POINTS = 4
#: Function: name of an image, stored width and height of its photograph (px) -> the image's camera
#: (px of the image) and pose (world to camera [4, 4], OpenCV axes).
CameraOf = Callable[[str, tuple[int, int]], tuple[Lens, NDArray[np.float64]]]


@dataclass(frozen=True)
class GivenPoses:
    """The cameras and points of a user's file."""

    names: Sequence[str]
    """Names of the images with a pose, with folders and suffix as in the file."""
    camera: CameraOf
    """Reads one camera; raises XrgsError if it is malformed."""
    points: NDArray[np.float64]
    """Points [P, 3]; P may be 0."""
    colors: NDArray[np.uint8]
    """Colours of the points [P, 3]."""
    observed: Mapping[str, NDArray[np.intp]] = field(default_factory=dict)
    """Image name -> ascending indices of its observed points, if known."""
    report: Mapping[str, Any] = field(default_factory=dict)
    """Entries for the variant's report, besides the notes."""
    notes: Sequence[str] = ()
    """Sentences on data that was chosen, left out or ignored."""
