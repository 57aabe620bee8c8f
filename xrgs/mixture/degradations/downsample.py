"""Downsamples width and height of a view by `variant.factor` (paper, section 4.1)."""

from __future__ import annotations

import numpy as np

from xrgs.config import VariantConf
from xrgs.photos import images
from xrgs.photos.images import ImageArray


def downsample(high: ImageArray, conf: VariantConf, _rng: np.random.Generator) -> ImageArray:
    """Return the view [H / factor, W / factor, 3]."""
    height, width = high.shape[:2]
    return images.resize(high, width // conf.factor, height // conf.factor)
