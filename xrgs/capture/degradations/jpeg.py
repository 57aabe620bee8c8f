"""Compresses a view aggressively and keeps its size."""

from __future__ import annotations

import io
from typing import TYPE_CHECKING

import numpy as np
from PIL import Image

from xrgs.capture import images

if TYPE_CHECKING:
    from xrgs.capture.images import ImageArray
    from xrgs.config import VariantConf


def jpeg(high: ImageArray, conf: VariantConf) -> ImageArray:
    """Return the view [H, W, 3] after JPEG with halved chroma (4:2:0) at `jpeg_quality`."""
    stream = io.BytesIO()
    encoded = Image.fromarray(images.to_8_bit(high))
    encoded.save(stream, "JPEG", quality=conf.jpeg_quality, subsampling="4:2:0")
    with Image.open(stream) as decoded:
        low: ImageArray = np.asarray(decoded, dtype=np.float32) / np.float32(255)
    return low
