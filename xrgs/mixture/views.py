"""The dataclasses of a variant and of SfM: views, cameras and points."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from xrgs.errors import XrgsError
from xrgs.photos.lens import Lens

#: Least number of points, since the initial scale of a Gaussian needs its three nearest points.
MIN_POINTS = 4


class SceneFailed(XrgsError):  # noqa: N818
    """No variant can be made of a scene, as of the paper's Leaves; `report` has SfM's results."""

    def __init__(self, message: str, report: dict[str, Any]) -> None:
        super().__init__(message)
        self.report = report


@dataclass(frozen=True)
class View:
    """An undistorted photograph on disk, and its pinhole camera."""

    name: str
    """File name of the photograph without suffix."""
    file: Path
    """A PNG, 8-bit RGB, of exactly `width` x `height` px."""
    split: str
    """`train`, `test` or `original`. An original is a degraded training view before degradation,
    with the same pose, at full size, for the control without degradation."""
    tag: str
    """`HR` or `LR`, the classes of the paper's method. Test views and originals are `HR`."""
    width: int
    height: int
    K: NDArray[np.float64]
    """Intrinsics [3, 3], px; pixel centres are at +0.5."""
    viewmat: NDArray[np.float64]
    """World to camera [4, 4], in the world of SfM, OpenCV axes."""
    sampling_rate: float
    """Relative sampling rate, in (0, 1]: focal length (px) over median depth of the view's SfM
    points, divided by the largest such ratio of the variant. Downsampling a view by `factor`
    divides it by `factor`."""
    mask: Path | None = None
    """An 8-bit grey PNG of the same size: 255 for a used pixel, 0 for a masked one. None uses all.
    The masked pixels in `file` are those of the photograph, or if degraded, filled with the colours
    of their neighbours."""
    supersampling: float = 1.0
    """Factor of width and height at which the view would show its content as finely as the finest
    training views (`xrgs.mixture.sampling_rate.needed_factors`): about 1 for an HR view and about
    `factor` for a degraded one. For a digital zoom, the size before upsampling counts."""


@dataclass(frozen=True)
class Variant:
    """A frozen mixed-resolution dataset for the training and evaluation of cells."""

    id: str
    """`<key>-<hash>`, where the hash covers the images, the cameras and the SfM points."""
    folder: Path
    """Folder of the variant."""
    scene: str
    """Name of the scene when the variant was built; a label that is not part of the hash."""
    factor: int
    """Size of HR views over size of LR views, as the method assumes it. The sizes of HR views are
    multiples of it."""
    held_out: bool
    """False if there are too few views to hold any out. The test views then are the training views
    in HR."""
    views: tuple[View, ...]
    """All views, sorted by (split, name)."""
    points: NDArray[np.float64]
    """SfM points [P, 3], in the world of SfM."""
    colors: NDArray[np.uint8]
    """Colours of the points [P, 3]."""
    report: dict[str, Any]
    """Results of SfM: registered views, points, reprojection error, every attempt."""
    world: NDArray[np.float64] = field(default_factory=lambda: np.eye(4))
    """The rigid transform [4, 4] from the world of given poses to the world of views and points."""


@dataclass(frozen=True)
class Reconstruction:
    """COLMAP's largest model; empty if there is none. Keys are indices of images."""

    lenses: dict[int, Lens]
    """Registered image -> its camera, in px of the image."""
    viewmats: dict[int, NDArray[np.float64]]
    """Registered image -> world to camera [4, 4], OpenCV axes."""
    points: NDArray[np.float64]
    """SfM points [P, 3]."""
    colors: NDArray[np.uint8]
    """Colours of the points [P, 3]."""
    observed: dict[int, NDArray[np.intp]]
    """Registered image -> ascending indices of its observed points."""
    report: dict[str, Any]
    """Settings and results, with the keys of the variant's report."""
    world: NDArray[np.float64] = field(default_factory=lambda: np.eye(4))
    """The rigid transform [4, 4] from the world of given poses to the world of `viewmats`."""
    apart: Mapping[int, int] = field(default_factory=dict)
    """Image that fits better with another camera than the shared one -> number of that camera
    (`xrgs.mixture.sfm.other_cameras`)."""
