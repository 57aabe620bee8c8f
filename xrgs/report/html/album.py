"""Encodes the images of the page as WebP in data URLs, within a number of bytes."""

from __future__ import annotations

import base64
import io
from typing import TYPE_CHECKING

import numpy as np
from matplotlib import colormaps
from PIL import Image

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

#: The longer side that an image of the page has at most, px.
_MAX_SIDE = 1008
#: The mean absolute difference of the channels, in 0..1, from which an error map is brightest.
ERROR_RANGE = 0.25
#: Error maps are shrunk by this factor: they show where a render is wrong, not each pixel.
_ERROR_SHRINK = 2
#: Quality of WebP, and the bytes that a pixel of a photograph takes with it at most, best first.
_QUALITIES = ((90, 0.40), (80, 0.22), (60, 0.13), (40, 0.09))


class Album:
    """Collects the images of a page. The same image is kept once.

    Args:
        max_bytes: The most bytes that the data URLs may take together.
        pixels: About how many pixels will be added in all, which decides the quality.
    """

    def __init__(self, max_bytes: int, pixels: int) -> None:
        self.urls: list[str] = []
        self._left = max_bytes
        self._numbers: dict[str, int] = {}
        fitting = (quality for quality, size in _QUALITIES if pixels * size * 4 / 3 <= max_bytes)
        self._quality = next(fitting, _QUALITIES[-1][0])

    def add(self, images: Sequence[Image.Image]) -> list[int] | None:
        """Add images that belong together.

        Args:
            images: Images of mode RGB.

        Returns:
            The place of each in `urls`; None, and nothing is added, where they do not fit.
        """
        urls = [data_url(image, self._quality) for image in images]
        new = dict.fromkeys(url for url in urls if url not in self._numbers)
        size = sum(map(len, new))
        if size > self._left:
            return None
        self._left -= size
        for url in new:
            self._numbers[url] = len(self.urls)
            self.urls.append(url)
        return [self._numbers[url] for url in urls]


def data_url(image: Image.Image, quality: int) -> str:
    """Encode an image.

    Args:
        image: An image of mode RGB; a side of more than 1008 px is shrunk to it.
        quality: 1 to 100, libwebp's scale.

    Returns:
        The data URL of a WebP.
    """
    if max(image.size) > _MAX_SIDE:
        image = image.copy()
        image.thumbnail((_MAX_SIDE, _MAX_SIDE), Image.Resampling.LANCZOS)
    stream = io.BytesIO()
    image.save(stream, "WEBP", quality=quality)
    return f"data:image/webp;base64,{base64.b64encode(stream.getvalue()).decode('ascii')}"


def to_image(array: NDArray[np.float32]) -> Image.Image:
    """Convert an array [H, W, 3] to an image; values outside 0..1 are clamped."""
    return Image.fromarray(np.round(np.clip(array, 0, 1) * 255).astype(np.uint8))


def error_map(photograph: Image.Image, render: Image.Image) -> Image.Image:
    """Draw where a render differs from its photograph.

    Args:
        photograph: An image of mode RGB.
        render: An image of the same size.

    Returns:
        The mean absolute difference of the channels, from black at 0 to pale yellow at
        `ERROR_RANGE` (matplotlib's magma), at half the size.

    Raises:
        ValueError: The sizes differ.
    """
    if photograph.size != render.size:
        raise ValueError("photograph and render differ in size")
    first, second = (np.asarray(image, dtype=np.float32) / 255 for image in (photograph, render))
    difference = np.abs(first - second).mean(axis=2) / ERROR_RANGE
    colored = colormaps["magma"](np.clip(difference, 0, 1), bytes=True)[..., :3]
    width, height = (max(1, side // _ERROR_SHRINK) for side in photograph.size)
    return Image.fromarray(np.ascontiguousarray(colored)).resize((width, height))
