"""Averages a view over the area of each LR pixel, as a sensor behind an ideal lens."""

from __future__ import annotations

import numpy as np

from xrgs.config import VariantConf
from xrgs.photos import images
from xrgs.photos.images import ImageArray


def box(high: ImageArray, conf: VariantConf, _rng: np.random.Generator) -> ImageArray:
    """Return the means [H / factor, W / factor, 3] of blocks of `factor` x `factor` pixels."""
    return images.block_means(high, conf.factor)
