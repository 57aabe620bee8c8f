"""The texture of a variant's photographs: one number a view, which stays where images are removed.

Section 7.2 of the paper finds XR-GS better on textured scenes and the baseline better on simple
ones, and does not say how texture is measured. Here it is the mean magnitude of a photograph's
gradient, which `xrgs.training.components.weighting` defines [xrgs, section 7].
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from xrgs.errors import StoreError
from xrgs.mixture.paths import trimmed_folder
from xrgs.photos import images
from xrgs.photos.images import ImageError
from xrgs.safeio.records import read_struct

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

#: The file of a trimmed variant with the texture of each view, by its split and name: `test/a`.
FILE = "textures.json"


def texture(image: NDArray[np.float32], mask: NDArray[np.bool_] | None = None) -> float:
    """Return the mean magnitude of an image's gradient, in intensity per px.

    It is `mean_gradient` of `xrgs.training.components.weighting`, always without the last row and
    column, which repeat others there. That function needs torch; this one does not.

    Args:
        image: [H, W, 3] in 0..1.
        mask: [H, W], True for a pixel that is used; None uses all.

    Returns:
        The mean over the pixels, at most sqrt(2); NaN where there is none.
    """
    if min(image.shape[:2]) < 2:
        return math.nan
    inner = image[:-1, :-1].astype(np.float64)
    squared = (image[:-1, 1:] - inner) ** 2 + (image[1:, :-1] - inner) ** 2
    magnitude = np.sqrt(squared.mean(axis=2))
    if mask is not None:
        magnitude = magnitude[mask[:-1, :-1] & mask[:-1, 1:] & mask[1:, :-1]]
    return float(magnitude.mean()) if magnitude.size else math.nan


def texture_of(variant: Path, view: str) -> float:
    """Return the texture of a photograph, as `test/a`; NaN where none can be read or was kept.

    The folder is the one that the variant has where it is not trimmed.
    """
    trimmed = trimmed_folder(variant.parent, variant.name)
    if not trimmed.is_dir():
        return _measured(variant, view)
    try:
        return textures(trimmed).get(view, math.nan)
    except StoreError:
        return math.nan


def textures(folder: Path) -> dict[str, float]:
    """Return the textures of a variant's views that can be read; of a trimmed one those kept."""
    if (folder / FILE).exists():
        return read_struct(folder / FILE, dict[str, float])
    views = sorted(
        f"{split}/{file.stem}"
        for split in ("test", "train")
        for file in (folder / "images" / split).glob("*.png")
    )
    found = {view: _measured(folder, view) for view in views}
    return {view: value for view, value in found.items() if not math.isnan(value)}


def _measured(folder: Path, view: str) -> float:
    """Return the texture of a photograph; NaN where it can't be read."""
    split, _, name = view.partition("/")
    mask = folder / "images" / f"{split}-masks" / f"{name}.png"
    try:
        image = images.read_png(folder / "images" / f"{view}.png")
        size = image.shape[1], image.shape[0]
        return texture(image, images.read_mask(mask, size) if mask.exists() else None)
    except (ImageError, StoreError):
        return math.nan
