"""What a mixed-resolution variant is once it is made: views, cameras, points."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from xrgs.errors import XrgsError


class SceneFailed(XrgsError):  # noqa: N818
    """A scene that can't be made into a variant, as the paper's Leaves; `report` says why."""

    def __init__(self, message: str, report: dict[str, Any]) -> None:
        super().__init__(message)
        self.report = report


@dataclass(frozen=True)
class View:
    """One undistorted photograph and its pinhole camera."""

    name: str
    """The photograph's file name without its ending."""
    file: Path
    """PNG, 8-bit RGB, exactly `width` x `height`."""
    split: str
    """`train`, `test`, or `original`: what a degraded training view was before, at its own size
    and from the same pose. Originals are for the control that degrades nothing."""
    tag: str
    """`HR` or `LR`; tests and originals, which nothing degraded, are `HR`."""
    width: int
    height: int
    K: NDArray[np.float64]  # [3, 3] px; pixel centres at +0.5
    viewmat: NDArray[np.float64]  # [4, 4] world to camera, OpenCV axes
    rho: float
    """Relative sampling rate in (0, 1]: focal length (px) over the median depth of the SfM points
    that the view sees, over the largest such of the variant. About 1/factor if downsampled."""


@dataclass(frozen=True)
class Variant:
    """What a cell trains and is tested on."""

    id: str
    """`<key>-<hash>`: the hash is of the images, the cameras and SfM's points."""
    path: Path
    scene: str
    """The scene's name when the variant was built; a label, not in the hash."""
    factor: int
    """How many times fewer pixels a side the method takes LR views to have; real captures are
    cropped to multiples of it too."""
    held_out: bool
    """False where there are too few views to hold any out: the tests are the trained poses, HR."""
    views: tuple[View, ...]  # sorted by (split, name)
    points: NDArray[np.float64]  # [P, 3] SfM points, world units of SfM
    colors: NDArray[np.uint8]  # [P, 3]
    report: dict[str, Any]
    """How SfM went: views registered, points, reprojection error, the recipe that worked."""
