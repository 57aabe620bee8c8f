"""Compresses a view aggressively and keeps its size."""

from __future__ import annotations

import numpy as np

from xrgs.config import VariantConf
from xrgs.photos import images
from xrgs.photos.images import ImageArray


def jpeg(high: ImageArray, conf: VariantConf, _rng: np.random.Generator) -> ImageArray:
    """Return the view [H, W, 3] after JPEG with halved chroma (4:2:0) at `jpeg_quality`."""
    return images.through_jpeg(high, conf.jpeg_quality)
