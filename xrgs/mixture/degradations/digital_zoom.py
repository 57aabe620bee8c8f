"""Removes detail from a view and keeps its size, as the digital zoom of a camera."""

from __future__ import annotations

import numpy as np

from xrgs.config import VariantConf
from xrgs.photos import images
from xrgs.photos.images import ImageArray


def digital_zoom(high: ImageArray, conf: VariantConf, _rng: np.random.Generator) -> ImageArray:
    """Return the view [H, W, 3] downsampled by `factor` and upsampled to its size."""
    height, width = high.shape[:2]
    small = images.resize(high, width // conf.factor, height // conf.factor)
    return images.resize(small, width, height)
