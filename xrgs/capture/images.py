"""Photographs: read, resize, save, and straighten. float32 [H, W, 3] in 0..1 in memory.

Nothing here imports torch or scikit-image before it is called.
"""

from __future__ import annotations

import io
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageOps

from xrgs.errors import XrgsError

Photo = NDArray[np.float32]  # [H, W, 3]

#: PIL goes by the content and not by the ending, and some of the formats that it knows are programs
#: for others to run.
_FORMATS = ("BMP", "JPEG", "PNG", "TIFF", "WEBP")
_EXIF_ORIENTATION = 0x0112
_EXIF_CAMERA = (0x010F, 0x0110)  # make, model
_EXIF_DETAILS = 0x8769
_EXIF_FOCAL = (0x920A, 0xA405)  # focal length in mm, and as of a 35 mm film


class ImageError(XrgsError):
    """A file that can't be read as a photograph; the message begins with its path."""


@dataclass(frozen=True)
class Lens:
    """A camera of one radial term, COLMAP's SIMPLE_RADIAL with its own focal length per axis.

    A point at (x, y) on the plane z = 1 falls on pixel (fx x (1 + k r²) + cx, fy y (1 + k r²) + cy)
    with r² = x² + y². Pixel centres are at +0.5.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    k: float = 0.0

    def at(self, width: int, height: int) -> Lens:
        """The same camera behind an image resized to `width` x `height`."""
        sx, sy = width / self.width, height / self.height
        return Lens(width, height, self.fx * sx, self.fy * sy, self.cx * sx, self.cy * sy, self.k)

    @property
    def K(self) -> NDArray[np.float64]:  # noqa: N802
        """[3, 3] px, the distortion left out."""
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1]])

    def straightened(self) -> Lens:
        """The pinhole camera of the same size, zoomed so that no pixel lacks a source.

        The zoom is the smallest that keeps the whole border inside the photograph; it depends on
        the border alone, so that an image and its resized copy get the same one.
        """
        if self.k == 0:
            return self
        t = np.linspace(0.0, 1.0, 257)
        edge = np.concatenate(
            [np.stack([t, 0 * t + s], -1) for s in (0.0, 1.0)]
            + [np.stack([0 * t + s, t], -1) for s in (0.0, 1.0)]
        )  # [B, 2] in fractions of the image
        border = edge * (self.width, self.height)
        low, high = 0.25, 8.0
        for _ in range(50):
            zoom = (low + high) / 2
            source = self._distorted(border, zoom)
            inside = np.all((source >= -1e-9) & (source <= (self.width, self.height)))
            # Beyond this radius a barrel lens's formula turns back, and would fold the picture.
            x = (border - (self.cx, self.cy)) / (self.fx * zoom, self.fy * zoom)
            inside &= np.all(1 + 3 * self.k * np.sum(x**2, axis=-1) > 0)
            low, high = (low, zoom) if inside else (zoom, high)
        return Lens(self.width, self.height, self.fx * high, self.fy * high, self.cx, self.cy)

    def _distorted(self, pixels: NDArray[np.float64], zoom: float) -> NDArray[np.float64]:
        """Where pixels [..., 2] of the pinhole camera of `zoom` are in the photograph."""
        centre = np.array([self.cx, self.cy])
        focal = np.array([self.fx, self.fy])
        x = (pixels - centre) / (focal * zoom)
        r2 = np.sum(x**2, axis=-1, keepdims=True)
        source: NDArray[np.float64] = focal * x * (1 + self.k * r2) + centre
        return source


def _header(path: Path) -> Image.Image:
    return Image.open(path, formats=_FORMATS)


def size(path: Path) -> tuple[int, int]:
    """Width and height as `read` would give them, from the header alone.

    Raises:
        ImageError: the header can't be read.
    """
    try:
        with _header(path) as image:
            turned = image.getexif().get(_EXIF_ORIENTATION, 1) >= 5
            return (image.height, image.width) if turned else (image.width, image.height)
    except Exception as error:  # of a damaged file PIL raises nearly any
        raise ImageError(f"{path}: not a readable image ({error})") from error


def camera_mark(path: Path) -> str:
    """What EXIF says of the camera: make, model, focal length; empty where it says none of it.

    Raises:
        ImageError: the header can't be read.
    """
    try:
        with _header(path) as image:
            exif = image.getexif()
            details = exif.get_ifd(_EXIF_DETAILS)
            told = [exif.get(tag) for tag in _EXIF_CAMERA] + [details.get(t) for t in _EXIF_FOCAL]
    except Exception as error:  # of a damaged file PIL raises nearly any
        raise ImageError(f"{path}: not a readable image ({error})") from error
    return "/".join("" if value is None else str(value).strip("\0 ") for value in told).strip("/")


def read(path: Path) -> Photo:
    """A photograph, upright (EXIF orientation applied), as RGB.

    Raises:
        ImageError: unreadable, truncated, or of more than 8 bits a channel.
    """
    photo: Photo = np.asarray(opened(path), dtype=np.float32) / np.float32(255)
    return photo


def opened(path: Path) -> Image.Image:
    """What `read` reads, as PIL has it.

    Raises:
        ImageError: as of `read`.
    """
    try:
        with _header(path) as image:
            image.load()
            if image.mode[0] in "IF":
                raise ValueError(f"{image.mode} pixels; only 8 bits a channel are read")
            return ImageOps.exif_transpose(image).convert("RGB")
    except Exception as error:  # of a damaged file PIL raises nearly any
        raise ImageError(f"{path}: unreadable or truncated image ({error})") from error


def save(path: Path, image: Photo) -> None:
    """Write an 8-bit RGB PNG, rounded to nearest and clamped to 0..1; the folder is made."""
    path.parent.mkdir(parents=True, exist_ok=True)
    pixels = np.round(np.clip(image, 0, 1) * 255).astype(np.uint8)
    Image.fromarray(pixels).save(path, compress_level=4)


def through_jpeg(image: Photo, quality: int) -> Photo:
    """What a JPEG of that quality (1 to 95, libjpeg's scale, chroma halved) keeps of an image."""
    pixels = np.round(np.clip(image, 0, 1) * 255).astype(np.uint8)
    stream = io.BytesIO()
    Image.fromarray(pixels).save(stream, "JPEG", quality=quality, subsampling="4:2:0")
    with Image.open(stream) as decoded:
        kept: Photo = np.asarray(decoded, dtype=np.float32) / np.float32(255)
    return kept


def resize(image: Photo, width: int, height: int) -> Photo:
    """Antialiased bicubic to an exact size, not clamped (torch's kernel, PIL's to 5e-5)."""
    import torch
    from torch.nn.functional import interpolate

    if image.shape[:2] == (height, width):
        return image
    batch = torch.from_numpy(image).movedim(-1, 0)[None]  # [1, 3, H, W]
    small = interpolate(
        batch, size=(height, width), mode="bicubic", antialias=True, align_corners=False
    )
    return np.ascontiguousarray(small[0].movedim(0, -1).numpy())


def straighten(image: Photo, lens: Lens) -> Photo:
    """The photograph that `lens.straightened()` would have taken; cubic spline interpolation.

    Raises:
        ValueError: the image is not of the lens's size.
    """
    if image.shape[:2] != (lens.height, lens.width):
        raise ValueError(f"image {image.shape[:2]}, lens {(lens.height, lens.width)}")
    if lens.k == 0:
        return image
    from skimage.transform import warp

    columns, rows = np.meshgrid(np.arange(lens.width) + 0.5, np.arange(lens.height) + 0.5)
    zoom = lens.straightened().fx / lens.fx
    source = lens._distorted(np.stack([columns, rows], -1), zoom) - 0.5  # [H, W, 2]
    coords = source[..., ::-1].transpose(2, 0, 1)  # [2, H, W] row, column
    bands = [warp(image[..., c], coords, order=3, mode="edge") for c in range(3)]
    return np.stack(bands, axis=-1).astype(np.float32)
