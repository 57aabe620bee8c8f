"""The dataclasses of a variant: its views, cameras and points."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from xrgs.errors import XrgsError


class SceneFailed(XrgsError):  # noqa: N818
    """A scene can't be made into a variant, as the paper's Leaves; `report` says how SfM went."""

    def __init__(self, message: str, report: dict[str, Any]) -> None:
        super().__init__(message)
        self.report = report


@dataclass(frozen=True)
class View:
    """One undistorted photograph on disk, and its pinhole camera."""

    name: str
    """The photograph's file name without its suffix."""
    file: Path
    """A PNG, 8-bit RGB, of exactly `width` x `height` px."""
    split: str
    """`train`, `test` or `original`. An original is a degraded training view before it was
    degraded: from the same pose, at its own size, for the control that degrades nothing."""
    tag: str
    """`HR` or `LR`, the classes of the paper's method. Test views and originals are `HR`."""
    width: int
    height: int
    K: NDArray[np.float64]
    """Intrinsics [3, 3], px; pixel centres are at +0.5."""
    viewmat: NDArray[np.float64]
    """World to camera [4, 4], in the world of SfM, OpenCV axes."""
    sampling_rate: float
    """The relative sampling rate, in (0, 1]: focal length (px) / median depth of the SfM points
    that the view observes, over the largest such ratio of the variant. Downsampling a view by
    `factor` divides it by `factor`."""
    mask: Path | None = None
    """An 8-bit grey PNG of the same size: 255 where a pixel is used, 0 elsewhere. None uses all.
    Below it the file has the photograph, or what a degradation made of its neighbours."""
    supersampling: float = 1.0
    """How many times as many px a side the view needs to show what it sees as finely as the finest
    training views (`xrgs.mixture.sampling_rate.needed_factors`): about 1 for an HR view and about
    `factor` for a degraded one. A digital zoom counts with the pixels that it resolves."""


@dataclass(frozen=True)
class Variant:
    """A frozen mixed-resolution dataset, which cells train and are evaluated on."""

    id: str
    """`<key>-<hash>`, where the hash covers the images, the cameras and the SfM points."""
    folder: Path
    """The folder that it was loaded from."""
    scene: str
    """The scene's name when the variant was built; a label that is not part of the hash."""
    factor: int
    """How many times fewer pixels per side the method takes LR views to have. The HR views of
    real captures are cropped to multiples of it too."""
    held_out: bool
    """False where there are too few views to hold any out: the test views are then the HR versions
    of the training poses."""
    views: tuple[View, ...]
    """All views, sorted by (split, name)."""
    points: NDArray[np.float64]
    """SfM points [P, 3], in the world of SfM."""
    colors: NDArray[np.uint8]
    """Their colours [P, 3]."""
    report: dict[str, Any]
    """How SfM went: registered views, points, reprojection error, every attempt."""
    world: NDArray[np.float64] = field(default_factory=lambda: np.eye(4))
    """The rigid transform [4, 4] from the world of given poses to the world of views and points."""
