"""Reads, resizes and saves photographs: float32 arrays [H, W, 3] in 0..1 in memory.

Photographs of users are read upright by their EXIF orientation, and in sRGB by their ICC profile or
the colours that they name. PNG, TIFF and HEIC keep all of their bits. HEIC needs pillow-heif (extra
`heic`). Of a file with several images the first is read (the primary one of HEIC, and of the JPEGs
that phones write with gain maps or depth). The images of a store are PNGs that `save` has written
and `read_png` reads. Nothing here imports torch before `resize` is called.

A function that reads a file raises `ImageError` if it is not such an image, and `UnreadableError`
if it can't be read now.
"""

from __future__ import annotations

import io
import struct
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, BinaryIO

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageOps, UnidentifiedImageError, features
from PIL.PngImagePlugin import PngInfo

from xrgs.errors import UnreadableError, XrgsError
from xrgs.photos import colour, tiff
from xrgs.safeio.atomic import atomic_writer
from xrgs.safeio.files import is_transient

ImageArray = NDArray[np.float32]  # [H, W, 3]

#: The formats that are read, by a file's content: PIL hands some of the others to external
#: programs. A TGA has no magic bytes, so that only its suffix tells it.
_FORMATS = ("AVIF", "BMP", "HEIF", "JPEG", "JPEG2000", "PNG", "PPM", "TIFF", "WEBP")
_TGA = frozenset({".tga"})
#: The suffixes of HEIC files, in lower case.
HEIC = frozenset({".heic", ".heif", ".hif"})
#: The suffixes that cameras and programs of today write, in lower case.
USUAL_SUFFIXES = HEIC | {".bmp", ".jpeg", ".jpg", ".png", ".tif", ".tiff", ".webp"}
#: The suffixes of files that are read as photographs and as masks, in lower case.
SUFFIXES = (
    USUAL_SUFFIXES
    | {".apng", ".avif", ".dib", ".j2k", ".jfi", ".jfif", ".jif", ".jp2", ".jpe", ".jpf", ".jpx"}
    | {".mpo", ".pbm", ".pgm", ".pnm", ".ppm"}
    | _TGA
)
#: The text chunk `Software` of the PNGs that this package writes.
SOFTWARE = "xrgs"
#: First bytes -> format, of files that people take for photographs and that are not read.
_OTHER_FORMATS = {
    b"\xff\x0a": "JPEG XL",
    b"\0\0\0\x0cJXL ": "JPEG XL",
    b"GIF8": "GIF",
    b"8BPS": "a Photoshop document",
}
#: Bytes 4 to 7 of files in HEIF's container, and the brands (bytes 8 to 11) of AVIF.
_HEIF_MAGIC, _AVIF_BRANDS = b"ftyp", (b"avif", b"avis")
#: The brands of photographs in this container; films in it have others.
_HEIF_BRANDS = (b"heic", b"heix", b"heim", b"heis", b"mif1", b"msf1", *_AVIF_BRANDS)
#: First bytes that only photographs have. BMP and PPM begin with two letters, as texts may, and
#: TIFF as cameras' raw files do.
_PHOTOGRAPH_MAGIC = (b"\xff\xd8\xff", b"\x89PNG\r\n\x1a\n", b"\0\0\0\x0cjP  ")
#: A JPEG 2000 or AVIF file has its colour box within this many first bytes.
_BOXES_BYTES = 1 << 20
#: The colour spaces of JPEG 2000 that are read: CMYK, sRGB, grey and sRGB's YCC.
_JP2_COLOURS = (12, 16, 17, 18)
_TIFF_MAGIC = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
_PNG_MAGIC = b"\x89PNG\r\n\x1a\n"
#: The chunks of a PNG that may hold EXIF or XMP.
_PNG_TEXT = (b"eXIf", b"iTXt", b"tEXt", b"zTXt")
#: The longest chunk of a PNG that is kept, bytes: headers and colours are shorter.
_SHORT_CHUNK = 64
#: The channels of a PNG's colour types: grey, RGB, palette, grey with alpha, RGBA.
_PNG_CHANNELS = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}
#: The largest photograph that is read, px: cameras give 200 megapixels, and PIL takes 1 GB for it.
MAX_PIXELS = 1 << 28
#: The largest image of a store that is read, px. In training it takes 200 MB, and 2.4 GB more while
#: a step compares a render with it.
MAX_PNG_PIXELS = 1 << 26
#: The most bytes of pixels per byte of a file: PNG's compression reaches 1032, and no photograph
#: of any format comes near. A drawing may, and up to _SMALL_PIXELS it takes little memory.
_MAX_EXPANSION, _SMALL_PIXELS = 1032, 1 << 24
#: PIL's mode -> the fewest bits of a pixel before compression; 24 for other modes.
_BITS = {"1": 1, "P": 1, "L": 8}
#: With `scene.alpha=mask`, pixels with a lower alpha are masked out. Our choice.
OPAQUE_FROM = 0.5
_EXIF_ORIENTATION = 0x0112
_EXIF_DETAILS, _EXIF_COLOUR_SPACE, _EXIF_INTEROPERABILITY = 0x8769, 0xA001, 0xA005
_TIFF_PROFILE, _TIFF_XMP = 34675, 700


class ImageError(XrgsError):
    """A file can't be read as a photograph; the message begins with its path."""


# PIL's limit holds for the whole process, and refuses photographs that `MAX_PIXELS` admits.
if Image.MAX_IMAGE_PIXELS is not None:
    Image.MAX_IMAGE_PIXELS = max(Image.MAX_IMAGE_PIXELS, MAX_PIXELS)


@contextmanager
def _stream(path: Path) -> Iterator[BinaryIO]:
    """Open a file; errors of reading it as an image name the file."""
    try:
        with path.open("rb") as stream, warnings.catch_warnings():
            warnings.filterwarnings("ignore", module="PIL")  # they name no file
            yield stream
    except MemoryError:
        raise
    except (tiff.RefusedError, colour.ColourError) as error:
        raise ImageError(f"{path}: {error}") from error
    except UnidentifiedImageError as error:
        why = f"cannot identify it as one of {', '.join(_FORMATS)}"
        if path.stat().st_size == 0:
            why = "the file is empty"
        raise ImageError(f"{path}: unreadable or truncated image ({why})") from error
    except Exception as error:  # PIL raises nearly anything on a damaged file
        # PIL's own OSErrors, of truncated files, have no number.
        if isinstance(error, OSError) and error.errno is not None and is_transient(error):
            raise UnreadableError(f"{path}: {error.strerror}; try again") from error
        why = (
            error.strerror if isinstance(error, OSError) and error.strerror else str(error).strip()
        )
        raise ImageError(f"{path}: unreadable or truncated image ({why})") from error


def _check_size(
    stream: BinaryIO, size: tuple[int, int], max_pixels: int, bits: int, *, drawing: bool = True
) -> None:
    """Refuse an image that is too large, or that a file of so few bytes can't hold.

    It is called before memory for the pixels is taken. `size` is in px, and `bits` are those of a
    pixel before compression. A small drawing compresses without limit.
    """
    width, height = size
    if width * height > max_pixels:
        raise tiff.RefusedError(
            f"it has {width} x {height} pixels; at most {max_pixels} in all are read"
        )
    file_bytes = stream.seek(0, 2)
    stream.seek(0)
    if drawing and width * height <= _SMALL_PIXELS:
        return
    if bits * width * height > 8 * _MAX_EXPANSION * file_bytes:
        raise tiff.RefusedError(f"{file_bytes} bytes are too few for {width} x {height} px")


def _formats(start: bytes, suffix: str) -> tuple[str, ...]:
    """Return the formats that PIL tries on a file with these first bytes; enable HEIF for HEIC."""
    for magic, name in _OTHER_FORMATS.items():
        if start.startswith(magic):
            raise tiff.RefusedError(f"it is {name}, which is not read; convert it to PNG or JPEG")
    if start[4:8] != _HEIF_MAGIC:
        others = tuple(name for name in _FORMATS if name not in ("HEIF", "AVIF"))
        return (*others, "TGA") if suffix.lower() in _TGA else others
    if start[8:12] in _AVIF_BRANDS:
        if not features.check("avif"):
            raise tiff.RefusedError(
                "it is AVIF, which this Pillow does not read; install a newer one"
            )
        return ("AVIF",)
    try:
        from pillow_heif import register_heif_opener
    except ImportError as error:
        raise tiff.RefusedError("HEIC needs pillow-heif: pip install 'xrgs[heic]'") from error
    register_heif_opener()
    return ("HEIF",)


def is_photograph(path: Path) -> bool | None:
    """Return whether a file without an image's suffix is a photograph, by its first bytes.

    None where it may be an image of a format that is not read; OSError if it can't be read.
    """
    with path.open("rb") as stream:
        start = stream.read(16)
    if start.startswith(_PHOTOGRAPH_MAGIC) or (start[:4], start[8:12]) == (b"RIFF", b"WEBP"):
        return True
    if start[4:8] == _HEIF_MAGIC:
        return start[8:12] in _HEIF_BRANDS
    return None if start.startswith((*_OTHER_FORMATS, *_TIFF_MAGIC)) else False


@dataclass(frozen=True)
class Header:
    """Size and depth of a photograph, as read before the pixels are decoded."""

    size: tuple[int, int]
    """Width and height with the EXIF orientation applied, px."""
    orientation: int
    """The EXIF orientation that is applied, 1 to 8; 1 if the tag is missing or invalid, and for
    HEIC, whose decoder turns the pixels."""
    channels: int
    """Values per pixel; 1 for a palette."""
    bits: int
    """Bits per value."""

    @property
    def is_deep_grey(self) -> bool:
        """Whether it has one channel of more than 8 bits, as depth maps have."""
        return self.channels == 1 and self.bits > 8


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
    """What was converted or ignored, such as `converted from Display P3 to sRGB`."""


class _PilFile:
    """A photograph that PIL opens; `tiff` decodes the PNGs and HEIC files of more than 8 bits."""

    def __init__(self, stream: BinaryIO, start: bytes, path: Path, note: str = "") -> None:
        self._stream, self.note = stream, note
        self.image = image = Image.open(stream, formats=_formats(start, path.suffix))
        is_heif, is_png = image.format == "HEIF", image.format == "PNG"
        self._chunks, has_late_exif = _png_chunks(stream) if is_png else ({}, False)
        self.channels, self.bits = len(image.getbands()), int(image.info.get("bit_depth", 8))
        if is_png:
            self.bits, colour_type = self._chunks[b"IHDR"][8:10]
            self.channels = _PNG_CHANNELS[colour_type]
        elif image.mode.startswith("I"):  # grey of a PGM or a JPEG 2000
            self.bits = 16
        deep_bits = self.channels * self.bits if self.bits > 8 else 0
        _check_size(stream, image.size, MAX_PIXELS, deep_bits or _BITS.get(image.mode, 24))
        self.profile: bytes | None = image.info.get("icc_profile")
        if b"cICP" in self._chunks:  # it overrides the profile (PNG, third edition)
            self.profile = None
        has_box = image.format in ("AVIF", "JPEG2000")
        self._box = _colour_box(stream, image.format == "AVIF") if has_box else b""
        if image.format == "JPEG2000" and self._box[:1] == b"\2":
            self.profile = self._box[3:]
        self.exif = Image.Exif()
        with suppress(Exception):  # PIL raises nearly anything on damaged EXIF
            # The method of PNGs decodes the pixels, to find EXIF behind them.
            self.exif = image.getexif() if has_late_exif else Image.Image.getexif(image)
        # PIL turns a TIFF on loading, and gives its turned size; HEIC's decoder ignores the tag.
        self.orientation = 1 if is_heif else _orientation(self.exif.get(_EXIF_ORIENTATION))
        self.size = image.size
        if image.format == "TIFF":
            self.size = image.tag_v2[256], image.tag_v2[257]  # type: ignore[attr-defined]

    @property
    def xmp(self) -> str:
        """The XMP of the file; empty if it has none."""
        found = self.image.info.get("xmp") or self.image.info.get("XML:com.adobe.xmp") or b""
        return found if isinstance(found, str) else found.decode("utf-8", errors="replace")

    @property
    def frames(self) -> int:
        """The number of images in the file."""
        # Further images of a JPEG are gain maps, depth, or the other half of a stereo pair.
        is_jpeg = self.image.format in ("JPEG", "MPO")
        return 1 if is_jpeg else getattr(self.image, "n_frames", 1)

    def encoding(self) -> colour.Encoding | None:
        """Return the colours that a file without an ICC profile names."""
        info = self.image.info
        cicp = self._chunks.get(b"cICP", b"")
        if len(cicp) == 4:
            if cicp[2]:
                raise colour.ColourError("its cICP names a matrix, which a PNG's colours have not")
            return colour.from_h273(cicp[0], cicp[1], 0 if cicp[3] else self.bits)
        if self._chunks:
            xy = info.get("chromaticity")
            return None if "srgb" in info else colour.from_png(info.get("gamma"), xy)
        if nclx := info.get("nclx_profile"):
            if not int(nclx["matrix_coefficients"]) and not int(nclx["full_range_flag"]):
                raise colour.ColourError("RGB values of narrow range are not read; save it as PNG")
            return colour.from_h273(
                int(nclx["color_primaries"]), int(nclx["transfer_characteristics"])
            )
        if self._box[:4] == b"nclx":  # of AVIF, whose decoder has applied the range
            primaries, transfer = struct.unpack_from(">HH", self._box, 4)
            return colour.from_h273(primaries, transfer)
        if self._box[:1] == b"\1":
            (number,) = struct.unpack_from(">I", self._box, 3)
            if number not in _JP2_COLOURS:
                raise colour.ColourError(f"colours of kind {number} of JPEG 2000 are not read")
        with suppress(Exception):  # PIL raises nearly anything on damaged EXIF
            interoperability = self.exif.get_ifd(_EXIF_INTEROPERABILITY).get(1, "")
            space = self.exif.get_ifd(_EXIF_DETAILS).get(_EXIF_COLOUR_SPACE)
            if interoperability.startswith("R03") or space == 2:
                return colour.adobe_rgb()
        return None

    def check_end(self) -> None:
        """Raise `ValueError` for a JPEG whose last part is zeros, or was never written.

        An interrupted copy leaves such a file at its full size. Zeros are valid codes of JPEG, so
        that PIL decodes them to grey without an error; only the marker of the end is missing.
        """
        if self.image.format not in ("JPEG", "MPO"):
            return
        self._stream.seek(2)
        while (head := self._stream.read(4))[:1] == b"\xff" and head[1:2] != b"\xda":
            self._stream.seek(int.from_bytes(head[2:], "big") - 2, 1)
        if head[1:2] == b"\xda" and b"\xff\xd9" not in self._stream.read():
            raise ValueError("it ends within its pixels")

    def load(self) -> tiff.Samples:
        """Decode the pixels."""
        image: Image.Image = self.image
        if self.bits > 8:
            self._stream.seek(0)
            if image.format == "HEIF":
                return tiff.decode_heif(self._stream)
            if image.format != "PNG":
                return tiff.of_grey(np.asarray(image))
            significant = max(self._chunks.get(b"sBIT", b"\x10"))
            return tiff.decode_png(self._stream.read(), significant)
        self.check_end()
        image.load()
        upright = image.format in ("HEIF", "TIFF")
        if image.mode == "LAB":
            self.profile = None  # it describes LAB, which `from_lab` converts
            note = "converted from CIELAB to sRGB"
            return tiff.Samples(colour.from_lab(image), None, note, upright)
        if image.has_transparency_data:
            # PIL converts premultiplied colours (La, RGBa) and palettes with alpha.
            with_alpha = image.convert("LA" if image.mode in ("1", "L", "LA", "La") else "RGBA")
            samples = np.asarray(with_alpha)
            alpha = samples[..., -1].astype(np.float32) / np.float32(255)
            return tiff.Samples(samples[..., :-1], alpha, is_upright=upright)
        if image.mode not in ("L", "RGB", "CMYK"):
            image = image.convert("L" if image.mode == "1" else "RGB")
        return tiff.Samples(np.atleast_3d(np.asarray(image)), None, is_upright=upright)


class _DeepTiff:
    """A TIFF of more than 8 bits per channel; `_PilFile` says what its members are."""

    def __init__(self, stream: BinaryIO, read: tiff.Tiff) -> None:
        self._tiff = read
        self.size = read.size
        self.orientation = _orientation(read.value(_EXIF_ORIENTATION))
        self.channels, self.bits = read.channels, read.bits
        _check_size(stream, self.size, MAX_PIXELS, self.channels * self.bits)
        self.profile: bytes | None = read.value(_TIFF_PROFILE)
        self.note = read.note
        self.exif = Image.Exif()
        with suppress(Exception):  # PIL raises nearly anything on damaged EXIF
            stream.seek(0)
            self.exif.load_from_fp(stream)

    @property
    def xmp(self) -> str:
        found = self._tiff.value(_TIFF_XMP, b"")
        return found.decode("utf-8", errors="replace") if isinstance(found, bytes) else ""

    @property
    def frames(self) -> int:
        return self._tiff.frames

    def encoding(self) -> colour.Encoding | None:
        return None

    def load(self) -> tiff.Samples:
        return self._tiff.decode()


def _file(stream: BinaryIO, path: Path) -> _PilFile | _DeepTiff:
    start = stream.read(16)
    stream.seek(0)
    if start[:4] not in _TIFF_MAGIC:
        return _PilFile(stream, start, path)
    read = tiff.Tiff(stream)
    if read.is_deep:
        return _DeepTiff(stream, read)
    stream.seek(0)
    return _PilFile(stream, start, path, read.note)


def _colour_box(stream: BinaryIO, is_avif: bool) -> bytes:
    """Return the content of a JPEG 2000 or AVIF file's colour box; empty if it has none."""
    stream.seek(0)
    start = stream.read(_BOXES_BYTES)
    at = start.find(b"colrnclx" if is_avif else b"colr")
    if at < 4:
        return b""
    return start[at + 4 : at - 4 + int.from_bytes(start[at - 4 : at], "big")]


def _png_chunks(stream: BinaryIO) -> tuple[dict[bytes, bytes], bool]:
    """Return the short chunks of a PNG by name, and whether EXIF or text follows the pixels."""
    chunks: dict[bytes, bytes] = {}
    is_late = False
    stream.seek(len(_PNG_MAGIC))
    while len(head := stream.read(8)) == 8:
        length, name = int.from_bytes(head[:4], "big"), head[4:]
        content = stream.read(length) if length <= _SHORT_CHUNK else b""
        stream.seek(4 if length <= _SHORT_CHUNK else length + 4, 1)
        chunks.setdefault(name, content)
        is_late |= b"IDAT" in chunks and name in _PNG_TEXT
        if name == b"IEND":
            break
    return chunks, is_late


def _orientation(value: object) -> int:
    """Return an EXIF orientation, 1 to 8; 1 for any other value."""
    return int(value) if value in range(1, 9) else 1  # type: ignore[call-overload]


def turned(array: NDArray[Any], orientation: int) -> NDArray[Any]:
    """Turn an array [H, W, ...] upright by its EXIF orientation."""
    if orientation >= 5:  # 5 to 8 are mirrored at the diagonal, then treated as 1 to 4
        array = array.swapaxes(0, 1)
    if orientation in (2, 3, 6, 7):
        array = array[:, ::-1]
    if orientation in (3, 4, 7, 8):
        array = array[::-1]
    return array


def turned_size(size: tuple[int, int], orientation: int) -> tuple[int, int]:
    """Return width and height after EXIF's turn, or before it: 5 to 8 exchange the two."""
    return size[::-1] if orientation >= 5 else size


def header(path: Path) -> Header:
    """Read the header of a photograph of at most `MAX_PIXELS`."""
    with _stream(path) as stream:
        return _header(_file(stream, path))


def _header(file: _PilFile | _DeepTiff) -> Header:
    size = turned_size(file.size, file.orientation)
    return Header(size, file.orientation, file.channels, file.bits)


def size(path: Path) -> tuple[int, int]:
    """Return the upright width and height of a photograph, px."""
    return header(path).size


def is_own(path: Path) -> bool:
    """Return whether a PNG is one that this package wrote: a render, a film's frame, a figure."""
    with _stream(path) as stream, Image.open(stream, formats=("PNG",)) as image:
        return image.info.get("Software") == SOFTWARE


def has_colour(path: Path) -> bool:
    """Return whether a file's pixels have three channels or more; masks and depth maps have one."""
    return header(path).channels >= 3


def thumbnail(path: Path, side: int) -> NDArray[np.uint8]:
    """Read a small grey picture of a photograph, [side, side], upright by its EXIF orientation."""
    with _stream(path) as stream:
        file = _file(stream, path)
        if isinstance(file, _PilFile) and file.bits <= 8:
            # JPEGs are decoded at down to an eighth of their size.
            file.check_end()
            file.image.draft("RGB", (16 * side, 16 * side))
            upright = ImageOps.exif_transpose(file.image).convert("RGB")
            return _small(upright, side)
    return small(decode(path).pixels, side)


def small(image: ImageArray, side: int) -> NDArray[np.uint8]:
    """Return a small grey picture [side, side] of an image [H, W, 3]."""
    return _small(Image.fromarray(to_8_bit(image)), side)


def _small(image: Image.Image, side: int) -> NDArray[np.uint8]:
    return np.asarray(image.convert("L").resize((side, side), Image.Resampling.BOX))


def metadata(path: Path) -> tuple[Image.Exif, dict[int, Any], str]:
    """Read a photograph's EXIF, its sub-directory on the exposure, and XMP; empty if absent."""
    with _stream(path) as stream:
        file, details = _file(stream, path), {}
        with suppress(Exception):  # PIL raises nearly anything on damaged EXIF
            details = file.exif.get_ifd(_EXIF_DETAILS)
        return file.exif, details, file.xmp


def decode(path: Path) -> Picture:
    """Decode a photograph: upright, in sRGB 0..1 (8-bit values / 255), with separate alpha.

    `ImageError` also says that it is larger than `MAX_PIXELS`, or that its values have no known
    white.
    """
    with _stream(path) as stream:
        file = _file(stream, path)
        head, several = _header(file), file.frames > 1
        samples = file.load()
        encoding = None if file.profile else file.encoding()
        pixels, colour_note = colour.convert(samples.colours, file.profile, encoding)
        alpha = samples.alpha
        if alpha is not None and alpha.min() >= 1:
            alpha = None
        if not samples.is_upright:
            pixels = turned(pixels, head.orientation)
            alpha = None if alpha is None else turned(alpha, head.orientation)
        if pixels.shape[1::-1] != head.size:
            raise ValueError(
                f"it has {pixels.shape[1]} x {pixels.shape[0]} pixels, not {head.size}"
            )
        notes = [note for note in (file.note, samples.note, colour_note) if note]
        if several:
            notes.append("only the first image of the file read")
        return Picture(np.ascontiguousarray(pixels), alpha, head.orientation, tuple(notes))


def composite(
    pixels: ImageArray, alpha: NDArray[np.float32], background: Sequence[float]
) -> ImageArray:
    """Lay pixels [H, W, 3] of an alpha [H, W] over one colour, RGB in 0..1."""
    share = alpha[:, :, np.newaxis]
    composited: ImageArray = pixels * share + np.asarray(background, np.float32) * (1 - share)
    return composited


def read(path: Path, background: Sequence[float] = (0, 0, 0)) -> ImageArray:
    """Decode a photograph, and lay it over a background where it is transparent: [H, W, 3]."""
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

    `size` is the width and height that it must have, px; None admits any.
    """
    return np.asarray(read_png_pil(path, size, max_pixels), np.float32) / np.float32(255)


def read_mask(path: Path, size: tuple[int, int]) -> NDArray[np.bool_]:
    """Read a mask of a store, a PNG as `save_mask` writes it: [H, W], True for a used pixel.

    `size` is the width and height that it must have, px.
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
    with _stream(path) as stream, Image.open(stream, formats=("PNG",)) as image:
        if size is not None and image.size != size:
            raise tiff.RefusedError(
                f"it has {image.width} x {image.height} pixels, not {size[0]} x {size[1]}"
            )
        if image.mode != mode:
            kind = "RGB" if mode == "RGB" else "grey"
            raise tiff.RefusedError(f"its pixels are {image.mode}, not 8-bit {kind}")
        _check_size(stream, image.size, max_pixels, _BITS.get(image.mode, 24), drawing=False)
        image.load()
        return image


def save(path: Path, image: ImageArray, *, durable: bool = True) -> None:
    """Write an 8-bit RGB PNG of an image [H, W, 3], clamped to 0..1 and rounded to nearest.

    The file is replaced atomically; its folder is made, but no parents of it. `durable` is as for
    `atomic_writer`.
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


def through_jpeg(image: ImageArray, quality: int) -> ImageArray:
    """Compress an image [H, W, 3] by JPEG with halved chroma (4:2:0), and decode it again."""
    stream = io.BytesIO()
    encoded = Image.fromarray(to_8_bit(image))
    encoded.save(stream, "JPEG", quality=quality, subsampling="4:2:0")
    with Image.open(stream) as decoded:
        return np.asarray(decoded, np.float32) / np.float32(255)


def block_means(image: NDArray[np.floating[Any]], side: int) -> ImageArray:
    """Average blocks of `side` x `side` pixels of an image [side * H, side * W, 3], in double."""
    height, width = image.shape[0] // side, image.shape[1] // side
    blocks = image.reshape(height, side, width, side, 3)
    means: ImageArray = blocks.mean(axis=(1, 3), dtype=np.float64).astype(np.float32)
    return means


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
