"""Downsamples a view by a Lanczos filter, which is sharper than `downsample`, with ringing."""

from __future__ import annotations

import numpy as np
from PIL import Image

from xrgs.config import VariantConf
from xrgs.photos.images import ImageArray


def lanczos(high: ImageArray, conf: VariantConf, _rng: np.random.Generator) -> ImageArray:
    """Return the view [H / factor, W / factor, 3] by Pillow's antialiased Lanczos-3 filter."""
    height, width = high.shape[:2]
    size = width // conf.factor, height // conf.factor
    # Pillow filters floats only in images with one channel.
    channels = (Image.fromarray(np.ascontiguousarray(high[..., c])) for c in range(3))
    return np.stack([np.asarray(c.resize(size, Image.Resampling.LANCZOS)) for c in channels], -1)
