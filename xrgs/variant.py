"""A mixed-resolution variant of a scene: built once, frozen, hashed, shared by every cell.

On disk, in a folder of its own: `variant.json` (what `Variant` holds), `images/*.png`, and
`report.json` (how SfM went). Nothing here imports torch, so that a plan can read it.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class View:
    """One undistorted photograph and its pinhole camera."""

    name: str
    """The photograph's file name without its ending."""
    file: Path
    """PNG, 8-bit RGB, exactly `width` x `height`."""
    split: str
    """`train` or `test`."""
    tag: str
    """`HR` or `LR`."""
    width: int
    height: int
    K: NDArray[np.float64]  # [3, 3] px; pixel centres at +0.5
    viewmat: NDArray[np.float64]  # [4, 4] world to camera, OpenCV axes


@dataclass(frozen=True)
class Variant:
    """What a cell trains and is tested on."""

    id: str
    """Hash of the source images, the variant's config and SfM's output."""
    path: Path
    scene: str
    factor: int
    held_out: bool
    """False where there are too few views to hold any out: the tests are the trained poses, HR."""
    views: tuple[View, ...]  # train and test, sorted by (split, name)
    points: NDArray[np.float64]  # [P, 3] SfM points, world units of SfM
    colors: NDArray[np.uint8]  # [P, 3]
    report: dict[str, Any]
    """How SfM went: views registered, points, reprojection error, the recipe that worked."""
