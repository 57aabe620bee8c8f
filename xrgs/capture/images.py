"""Reads, resizes and saves photographs: float32 arrays [H, W, 3] in 0..1 in memory.

Nothing here imports torch before it is called.
"""

from __future__ import annotations

import io
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageOps

from xrgs.errors import XrgsError
from xrgs.safeio.atomic import atomic_writer
from xrgs.safeio.confined import ConfinedPath, confined

ImageArray = NDArray[np.float32]  # [H, W, 3]

#: The formats that are read. PIL goes by the content of a file and not by its suffix, and it hands
#: some of the other formats that it knows to external programs.
_FORMATS = ("BMP", "JPEG", "PNG", "TIFF", "WEBP")
_EXIF_ORIENTATION = 0x0112
_EXIF_CAMERA = (0x010F, 0x0110)  # make, model
_EXIF_DETAILS = 0x8769
_EXIF_FOCAL = (0x920A, 0xA405)  # focal length in mm, and its equivalent on 35 mm film


class ImageError(XrgsError):
    """A file can't be read as a photograph; the message begins with its path."""


@contextmanager
def _open(path: Path | ConfinedPath) -> Iterator[Image.Image]:
    with confined(path).open() as stream, Image.open(stream, formats=_FORMATS) as image:
        yield image


def size(path: Path | ConfinedPath) -> tuple[int, int]:
    """Read the size that `read` would give an image, from the header alone.

    Args:
        path: The image file.

    Returns:
        Width and height, px, after the EXIF orientation is applied.

    Raises:
        ImageError: The header can't be read.
    """
    try:
        with _open(path) as image:
            transposed = image.getexif().get(_EXIF_ORIENTATION, 1) >= 5
            return (image.height, image.width) if transposed else (image.width, image.height)
    except Exception as error:  # PIL raises nearly anything on a damaged file
        raise ImageError(f"{path}: not a readable image ({error})") from error


def exif_camera(path: Path | ConfinedPath) -> str:
    """Read from EXIF which camera and focal length took a photograph.

    Args:
        path: The image file.

    Returns:
        `make/model/focal length/35 mm equivalent`; empty where EXIF has none of them.

    Raises:
        ImageError: The header can't be read.
    """
    try:
        with _open(path) as image:
            exif = image.getexif()
            details = exif.get_ifd(_EXIF_DETAILS)
            values = [exif.get(tag) for tag in _EXIF_CAMERA] + [details.get(t) for t in _EXIF_FOCAL]
    except Exception as error:  # PIL raises nearly anything on a damaged file
        raise ImageError(f"{path}: not a readable image ({error})") from error
    return "/".join("" if value is None else str(value).strip("\0 ") for value in values).strip("/")


def read(path: Path | ConfinedPath) -> ImageArray:
    """Read a photograph as RGB, with the EXIF orientation applied.

    Args:
        path: The image file.

    Returns:
        [H, W, 3], its 8-bit values / 255.

    Raises:
        ImageError: The file is unreadable, truncated, or has more than 8 bits per channel.
    """
    image: ImageArray = np.asarray(read_pil(path), dtype=np.float32) / np.float32(255)
    return image


def read_pil(path: Path | ConfinedPath) -> Image.Image:
    """Read a photograph as `read` does, into PIL's own image.

    Args:
        path: The image file.

    Returns:
        An image of mode RGB.

    Raises:
        ImageError: As `read`.
    """
    try:
        with _open(path) as image:
            image.load()
            if image.mode[0] in "IF":
                raise ValueError(f"{image.mode} pixels; only 8 bits per channel are read")
            return ImageOps.exif_transpose(image).convert("RGB")
    except Exception as error:  # PIL raises nearly anything on a damaged file
        raise ImageError(f"{path}: unreadable or truncated image ({error})") from error


def save(path: Path | ConfinedPath, image: ImageArray, *, durable: bool = True) -> None:
    """Write an 8-bit RGB PNG, clamped to 0..1 and rounded to nearest.

    Args:
        path: The file, which is replaced atomically; its folder is made where it is missing.
        image: [H, W, 3].
        durable: As for `atomic_writer`.

    Raises:
        OSError: The file can't be written.
    """
    confined(path).make_parent()
    with atomic_writer(path, durable=durable) as stream:
        Image.fromarray(_to_8_bit(image)).save(stream, "PNG", compress_level=4)


def _to_8_bit(image: ImageArray) -> NDArray[np.uint8]:
    return np.round(np.clip(image, 0, 1) * 255).astype(np.uint8)


def through_jpeg(image: ImageArray, quality: int) -> ImageArray:
    """Encode an image as JPEG with halved chroma (4:2:0), and decode it again.

    Args:
        image: [H, W, 3] in 0..1; what is outside is clamped.
        quality: 1 to 95, libjpeg's scale.

    Returns:
        The decoded image, [H, W, 3] in 0..1.
    """
    stream = io.BytesIO()
    Image.fromarray(_to_8_bit(image)).save(stream, "JPEG", quality=quality, subsampling="4:2:0")
    with Image.open(stream) as decoded:
        result: ImageArray = np.asarray(decoded, dtype=np.float32) / np.float32(255)
    return result


def resize(image: ImageArray, width: int, height: int) -> ImageArray:
    """Resize an image by antialiased bicubic interpolation.

    It is torch's `interpolate(mode="bicubic", antialias=True)`, which agrees with PIL's BICUBIC to
    5e-5.

    Args:
        image: [H, W, 3].
        width: The exact new width, px.
        height: The exact new height, px.

    Returns:
        [height, width, 3], not clamped; the image itself where it has that size.
    """
    import torch
    from torch.nn.functional import interpolate

    if image.shape[:2] == (height, width):
        return image
    batch = torch.from_numpy(image).movedim(-1, 0)[None]  # [1, 3, H, W]
    resized = interpolate(
        batch, size=(height, width), mode="bicubic", antialias=True, align_corners=False
    )
    return np.ascontiguousarray(resized[0].movedim(0, -1).numpy())
