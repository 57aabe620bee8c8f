"""Reads, resizes and saves photographs: float32 arrays [H, W, 3] in 0..1 in memory.

Photographs of users are read in six formats, with their EXIF orientation; HEIC needs pillow-heif,
which is an extra. The images of a store are PNGs of `save`, and are read by `read_png` alone.
Nothing here imports torch before `resize` is called.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import IO, TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageOps
from PIL.PngImagePlugin import PngInfo

from xrgs.errors import UnreadableError, XrgsError
from xrgs.safeio.atomic import atomic_writer
from xrgs.safeio.files import is_transient

if TYPE_CHECKING:
    from typing import BinaryIO

ImageArray = NDArray[np.float32]  # [H, W, 3]

#: The formats that are read. PIL goes by the content of a file and not by its suffix, and it hands
#: some of the other formats that it knows to external programs.
_FORMATS = ("BMP", "HEIF", "JPEG", "PNG", "TIFF", "WEBP")
#: The suffixes of HEIC files, in lower case.
HEIC = frozenset({".heic", ".heif", ".hif"})
#: What the PNGs of this package have in their text chunk `Software`.
SOFTWARE = "xrgs"
#: What a HEIC file has after its first four bytes, as other files of its container do.
_HEIF_MAGIC = b"ftyp"
#: The largest photograph that is read: cameras give 200 megapixels, and PIL takes 1 GB for this.
MAX_PIXELS = 1 << 28
#: The largest image of a store that is read. In training it takes 800 MB.
MAX_PNG_PIXELS = 1 << 26
#: Deflate, the compression of PNGs, makes at most 1032 bytes of one, and no photograph of any
#: format shrinks as much. A drawing may; up to so many pixels it takes little memory.
_MAX_EXPANSION, _SMALL_PIXELS = 1032, 1 << 24
#: The fewest bits of a pixel in a file by PIL's modes, as masks and palettes have them; others 24.
_BITS = {"1": 1, "P": 1, "L": 8}
#: With `scene.alpha=mask`, pixels of a lower alpha are outside. Our choice.
OPAQUE_FROM = 0.5
#: The formats that PIL turns upright by itself. The tag of a TIFF stays until it is loaded.
_UPRIGHT = ("HEIF", "TIFF")
_EXIF_ORIENTATION = 0x0112
_EXIF_CAMERA = (0x010F, 0x0110)  # make, model
_EXIF_DETAILS = 0x8769
_EXIF_FOCAL_35MM = 0xA405  # the focal length that has this field of view on 35 mm film
_EXIF_FOCAL = (0x920A, _EXIF_FOCAL_35MM)  # in mm


class ImageError(XrgsError):
    """A file can't be read as a photograph; the message begins with its path."""


# PIL's limit holds for the whole process, and refuses photographs that `MAX_PIXELS` admits.
if Image.MAX_IMAGE_PIXELS is not None:
    Image.MAX_IMAGE_PIXELS = max(Image.MAX_IMAGE_PIXELS, MAX_PIXELS)


@contextmanager
def _opened(
    path: Path, formats: tuple[str, ...] = _FORMATS, max_pixels: int = MAX_PIXELS
) -> Iterator[Image.Image]:
    """Open an image whose header declares at most so many pixels; every error names the file."""
    try:
        with (
            path.open("rb") as stream,
            Image.open(stream, formats=_known(formats, stream)) as image,
        ):
            if image.width * image.height > max_pixels:
                size = f"{image.width} x {image.height}"
                raise ValueError(f"it has {size} pixels; at most {max_pixels} in all are read")
            yield image
    except MemoryError:
        raise
    except Exception as error:  # PIL raises nearly anything on a damaged file
        # PIL's own OSErrors, of truncated files, have no number.
        if isinstance(error, OSError) and error.errno is not None and is_transient(error):
            raise UnreadableError(f"{path}: {error.strerror}; try again") from error
        why = error.strerror if isinstance(error, OSError) and error.strerror else error
        raise ImageError(f"{path}: unreadable or truncated image ({why})") from error


def _known(formats: tuple[str, ...], stream: BinaryIO) -> tuple[str, ...]:
    """Return the formats that PIL knows; HEIF is registered where the file may be HEIF."""
    if "HEIF" not in formats:
        return formats
    start = stream.read(8)
    stream.seek(0)
    if start[4:] != _HEIF_MAGIC:
        return tuple(name for name in formats if name != "HEIF")
    try:
        from pillow_heif import register_heif_opener
    except ImportError as error:
        raise ValueError("HEIC needs pillow-heif: pip install 'xrgs[heic]'") from error
    register_heif_opener()
    return formats


@dataclass(frozen=True)
class Header:
    """What a file says of its photograph before the pixels are decoded."""

    size: tuple[int, int]
    """Width and height with the EXIF orientation applied, px."""
    orientation: int
    """The EXIF orientation, 1 to 8; 1 where the tag is missing or invalid."""
    is_deep_grey: bool
    """Whether it has one channel of more than 8 bits, as depth maps have."""


@dataclass(frozen=True)
class Picture:
    """A decoded photograph."""

    pixels: ImageArray
    """[H, W, 3] sRGB in 0..1, upright; not multiplied by alpha."""
    alpha: NDArray[np.float32] | None
    """[H, W] in 0..1; None where every pixel is opaque."""
    orientation: int
    """The EXIF orientation that was applied, as in `Header`."""
    notes: tuple[str, ...]
    """What was done to it, as in `converted from Display P3`."""


def header(path: Path) -> Header:
    """Read the header of a photograph; `decode` gives pixels of its size.

    Raises:
        UnreadableError: The file can't be read now.
        ImageError: The file is not an image, or is larger than `MAX_PIXELS`.
    """
    with _opened(path) as image:
        return _header(image)


def size(path: Path) -> tuple[int, int]:
    """Return the width and height of a photograph, px, as `header` does."""
    return header(path).size


def _header(image: Image.Image) -> Header:
    orientation, (width, height) = _orientation(image), image.size
    turns = orientation >= 5 and image.format not in _UPRIGHT
    return Header(
        size=(height, width) if turns else (width, height),
        orientation=orientation,
        is_deep_grey=image.mode[0] in "IF",
    )


def _orientation(image: Image.Image) -> int:
    """Read the EXIF orientation; a value of another type than a number of 1 to 8 is ignored."""
    with suppress(Exception):  # PIL raises nearly anything on damaged EXIF
        value = image.getexif().get(_EXIF_ORIENTATION, 1)
        return int(value) if value in range(1, 9) else 1
    return 1


def is_own(path: Path) -> bool:
    """Return whether a file is a PNG that this package wrote: a render, a film's frame, a figure.

    Raises:
        UnreadableError: The file can't be read now.
        ImageError: The file is not a PNG.
    """
    with _opened(path, ("PNG",)) as image:
        return image.info.get("Software") == SOFTWARE


def has_colour(path: Path) -> bool:
    """Return whether a file's pixels have three channels or more; masks and depth maps have one.

    Raises:
        UnreadableError: The file can't be read now.
        ImageError: The file is not an image.
    """
    with _opened(path) as image:
        return len(image.getbands()) >= 3


def thumbnail(path: Path, side: int) -> NDArray[np.uint8]:
    """Read a small grey picture of a photograph, [side, side], upright by its EXIF orientation.

    Raises:
        UnreadableError: The file can't be read now.
        ImageError: The file is unreadable or truncated.
    """
    with _opened(path) as image:
        image.draft("RGB", (8 * side, 8 * side))  # JPEGs are decoded at down to an eighth
        upright = ImageOps.exif_transpose(image).convert("RGB").convert("L")
        return np.asarray(upright.resize((side, side), Image.Resampling.BOX))


def exif_camera(path: Path) -> str:
    """Read from EXIF which camera and focal length took a photograph.

    Returns:
        `make/model/focal length/35 mm equivalent`; empty where EXIF has none of them.

    Raises:
        UnreadableError: The file can't be read now.
        ImageError: The file is not an image.
    """
    with _opened(path) as image:
        exif, details = image.getexif(), {}
        with suppress(Exception):  # PIL raises nearly anything on damaged EXIF
            details = exif.get_ifd(_EXIF_DETAILS)
        values = [exif.get(tag) for tag in _EXIF_CAMERA] + [details.get(t) for t in _EXIF_FOCAL]
    return "/".join("" if value is None else str(value).strip("\0 ") for value in values).strip("/")


def exif_focal(path: Path) -> float | None:
    """Read from EXIF the focal length for a film of 36 x 24 mm, mm; None where it is not there.

    Raises:
        UnreadableError: The file can't be read now.
        ImageError: The file is not an image.
    """
    with _opened(path) as image, suppress(Exception):  # PIL raises nearly anything on damaged EXIF
        focal = float(image.getexif().get_ifd(_EXIF_DETAILS)[_EXIF_FOCAL_35MM])
        return focal if 1 < focal < 10_000 else None
    return None


def decode(path: Path) -> Picture:
    """Decode a photograph: 8-bit values / 255.

    Raises:
        UnreadableError: The file can't be read now.
        ImageError: The file is unreadable, truncated, larger than `MAX_PIXELS`, or has more than 8
            bits per channel.
    """
    with _opened(path) as image:
        head = _header(image)
        if image.width * image.height > _SMALL_PIXELS:
            _check_expansion(path, image)
        image.load()
        if image.mode[0] in "IF":
            raise ValueError(f"{image.mode} pixels; only 8 bits per channel are read")
        turned = ImageOps.exif_transpose(image)
        alpha = None
        if turned.has_transparency_data:
            turned = turned.convert("RGBA")
            opacity = np.asarray(turned.getchannel("A"), dtype=np.float32)
            if opacity.min() < 255:
                alpha = opacity / np.float32(255)
        return Picture(_to_array(turned.convert("RGB")), alpha, head.orientation, ())


def composite(
    pixels: ImageArray, alpha: NDArray[np.float32], background: Sequence[float]
) -> ImageArray:
    """Lay pixels [H, W, 3] of an alpha [H, W] over one colour, RGB in 0..1."""
    share = alpha[:, :, np.newaxis]
    composited: ImageArray = pixels * share + np.asarray(background, np.float32) * (1 - share)
    return composited


def read(path: Path, background: Sequence[float] = (0, 0, 0)) -> ImageArray:
    """Decode a photograph, and lay it over a background where it is transparent: [H, W, 3].

    Raises:
        UnreadableError: The file can't be read now.
        ImageError: As for `decode`.
    """
    picture = decode(path)
    if picture.alpha is None:
        return picture.pixels
    return composite(picture.pixels, picture.alpha, background)


def read_png(
    path: Path,
    size: tuple[int, int] | None = None,
    max_pixels: int = MAX_PNG_PIXELS,
) -> ImageArray:
    """Read an image of a store, a PNG as `save` writes it: [H, W, 3], its 8-bit values / 255.

    Args:
        path: The file.
        size: The width and height that it must have, px; None admits any.
        max_pixels: The most pixels that it may have.

    Raises:
        UnreadableError: The file can't be read now.
        ImageError: The file is not such a PNG.
    """
    return _to_array(read_png_pil(path, size, max_pixels))


def read_mask(path: Path, size: tuple[int, int]) -> NDArray[np.bool_]:
    """Read a mask of a store, a PNG as `save_mask` writes it: [H, W], True for a used pixel.

    Args:
        path: The file.
        size: The width and height that it must have, px.

    Raises:
        UnreadableError: The file can't be read now.
        ImageError: The file is not such a PNG.
    """
    mask: NDArray[np.bool_] = np.asarray(read_png_pil(path, size, mode="L")) > 127
    return mask


def read_png_pil(
    path: Path,
    size: tuple[int, int] | None = None,
    max_pixels: int = MAX_PNG_PIXELS,
    mode: str = "RGB",
) -> Image.Image:
    """Read a PNG as `read_png` does, into an image of PIL of mode RGB, or L for grey."""
    with _opened(path, ("PNG",), max_pixels) as image:
        if size is not None and image.size != size:
            raise ValueError(
                f"it has {image.width} x {image.height} pixels, not {size[0]} x {size[1]}"
            )
        if image.mode != mode:
            kind = "RGB" if mode == "RGB" else "grey"
            raise ValueError(f"its pixels are {image.mode}, not 8-bit {kind}")
        _check_expansion(path, image)
        image.load()
        return image


def _check_expansion(path: Path, image: Image.Image) -> None:
    """Refuse an image that no file of these bytes can hold, before memory is taken for it."""
    file_bytes = path.lstat().st_size
    bits = _BITS.get(image.mode, 24)
    if bits * image.width * image.height > 8 * _MAX_EXPANSION * file_bytes:
        raise ValueError(f"{file_bytes} bytes are too few for {image.width} x {image.height} px")


def _to_array(image: Image.Image) -> ImageArray:
    array: ImageArray = np.asarray(image, dtype=np.float32) / np.float32(255)
    return array


def save(path: Path, image: ImageArray, *, durable: bool = True) -> None:
    """Write an 8-bit RGB PNG, clamped to 0..1 and rounded to nearest.

    Args:
        path: The file, which is replaced atomically; its folder is made in an existing one.
        image: [H, W, 3].
        durable: As for `atomic_writer`.
    """
    path.parent.mkdir(exist_ok=True)  # not parents: a store that vanished stays away
    with atomic_writer(path, durable=durable) as stream:
        write_png(stream, Image.fromarray(to_8_bit(image)))


def write_png(stream: IO[bytes], image: Image.Image) -> None:
    """Write a PNG that `is_own` recognises, so that no render is taken for a photograph."""
    text = PngInfo()
    text.add_text("Software", SOFTWARE)
    image.save(stream, "PNG", compress_level=4, pnginfo=text)


def save_mask(path: Path, mask: NDArray[np.bool_], *, durable: bool = True) -> None:
    """Write a mask [H, W] as `save` writes an image: 8-bit grey, 255 where it is True."""
    path.parent.mkdir(exist_ok=True)
    with atomic_writer(path, durable=durable) as stream:
        Image.fromarray(mask.astype(np.uint8) * 255).save(stream, "PNG", compress_level=4)


def to_8_bit(image: ImageArray) -> NDArray[np.uint8]:
    """Clamp an image to 0..1, and round it to the nearest of 256 values."""
    return np.round(np.clip(image, 0, 1) * 255).astype(np.uint8)


def resize(image: ImageArray, width: int, height: int) -> ImageArray:
    """Resize an image [H, W, 3] by antialiased bicubic interpolation; it is not clamped.

    It is torch's `interpolate(mode="bicubic", antialias=True)`, which agrees with PIL's BICUBIC to
    5e-5. An image that has the size already is returned as it is.
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
