"""Photographs that are read, saved, or refused within bounds of memory; test_fuzz damages some."""

from __future__ import annotations

import errno
import io
import os
import struct
import sys
import tracemalloc
import zlib
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pillow_heif
import pytest
import tifffile
from PIL import Image

from tests.photos.made_files import ASCII, BYTE, FLOAT, LONG, SHORT, exif_entry, png, with_entry
from xrgs.errors import UnreadableError
from xrgs.photos import exif as exif_of
from xrgs.photos import images
from xrgs.photos.images import ImageError

#: How Pillow turns a picture by its EXIF orientation; the other values change nothing.
TURNS = {
    2: Image.Transpose.FLIP_LEFT_RIGHT,
    3: Image.Transpose.ROTATE_180,
    4: Image.Transpose.FLIP_TOP_BOTTOM,
    5: Image.Transpose.TRANSPOSE,
    6: Image.Transpose.ROTATE_270,
    7: Image.Transpose.TRANSVERSE,
    8: Image.Transpose.ROTATE_90,
}
#: The formats that keep every bit, and JPEG.
SAVED: dict[str, dict[str, Any]] = {
    "png": {},
    "tif": {},
    "webp": {"lossless": True},
    "heic": {"quality": -1, "chroma": 444, "matrix_coefficients": 0},
    "jpg": {"quality": 100, "subsampling": 0},
}
pillow_heif.register_heif_opener()


@pytest.fixture
def noise() -> images.ImageArray:
    return np.random.default_rng(0).random((40, 60, 3), dtype=np.float32)


def test_a_saved_image_is_read_to_half_a_step(tmp_path: Path, noise: images.ImageArray) -> None:
    images.save(tmp_path / "new" / "a.png", noise * 1.2 - 0.1)
    read = images.read(tmp_path / "new" / "a.png")
    assert read.dtype == np.float32
    assert np.abs(read - np.clip(noise * 1.2 - 0.1, 0, 1)).max() <= 0.5 / 255 + 1e-6


@pytest.mark.parametrize(
    ("suffix", "orientation"),
    [
        *(("png", orientation) for orientation in [*range(10), 255]),
        *(
            (suffix, orientation)
            for suffix in SAVED
            if suffix != "png"
            for orientation in (2, 5, 6)
        ),
    ],
)
def test_exif_orientation_is_applied_once_to_image_and_size(
    tmp_path: Path, suffix: str, orientation: int
) -> None:
    """Once also where Pillow (TIFF) or libheif turns by itself."""
    noise = np.random.default_rng(0).integers(0, 256, (5, 8, 3), dtype=np.uint8)
    stored = Image.fromarray(noise).resize((64, 40), Image.Resampling.BICUBIC)
    exif = Image.Exif()
    exif[0x0112] = orientation
    file = tmp_path / f"a.{suffix}"
    stored.save(file, exif=exif.tobytes() if suffix == "heic" else exif, **SAVED[suffix])
    upright = stored.transpose(TURNS[orientation]) if orientation in TURNS else stored
    picture = images.decode(file)
    assert images.size(file) == picture.pixels.shape[1::-1] == upright.size
    error = np.abs(picture.pixels - np.asarray(upright, dtype=np.float32) / 255).max()
    assert error < (0.03 if suffix == "jpg" else 1e-6)
    applied = orientation if orientation in range(1, 9) and suffix != "heic" else 1
    assert (picture.orientation, images.header(file).orientation) == (applied, applied)


@pytest.mark.parametrize("suffix", ["jpg", "tif"])
@pytest.mark.parametrize(
    ("kind", "count", "value", "applied"),
    [
        (LONG, 1, b"\6\0\0\0", 6),
        (SHORT, 2, b"\6\0\6\0", 6),
        (FLOAT, 1, struct.pack("<f", 6.5), 1),
        (BYTE, 1, b"\6", 1),
        (ASCII, 2, b"6\0", 1),
        (SHORT, 0, b"\6\0", 1),
    ],
)
def test_an_orientation_of_another_type_turns_all_or_nothing(
    tmp_path: Path, suffix: str, kind: int, count: int, value: bytes, applied: int
) -> None:
    stored = Image.linear_gradient("L").resize((60, 40)).convert("RGB")
    file = tmp_path / f"a.{suffix}"
    if suffix == "tif":
        stored.save(file)
        file.write_bytes(with_entry(file.read_bytes(), kind, count, value))
    else:
        stored.save(file, exif=exif_entry(kind, count, value))
    picture = images.decode(file)
    size = (40, 60) if applied == 6 else (60, 40)
    assert images.size(file) == picture.pixels.shape[1::-1] == size
    assert picture.orientation == applied


def test_exif_behind_the_pixels_of_a_png_is_found(tmp_path: Path) -> None:
    content = png(np.zeros((40, 60, 3)), bits=8)
    exif = exif_entry(SHORT, 1, b"\6\0")[6:]
    chunk = b"eXIf" + exif
    last = len(content) - 12
    late = struct.pack(">I", len(exif)) + chunk + struct.pack(">I", zlib.crc32(chunk))
    (tmp_path / "a.png").write_bytes(content[:last] + late + content[last:])
    assert images.size(tmp_path / "a.png") == (40, 60)
    assert images.read(tmp_path / "a.png").shape == (60, 40, 3)
    place = content.index(b"IDAT") + 8
    damaged = content[:place] + bytes(8) + content[place + 8 : last] + late + content[last:]
    (tmp_path / "a.png").write_bytes(damaged)
    with pytest.raises(ImageError, match=r"a\.png: unreadable or truncated"):
        images.read(tmp_path / "a.png")


@pytest.mark.parametrize("progressive", [False, True])
def test_a_jpeg_whose_last_part_is_zeros_is_refused(
    tmp_path: Path, noise: images.ImageArray, progressive: bool
) -> None:
    """An interrupted copy leaves it so; its thumbnail, which is in the header, is whole."""
    photograph, small = io.BytesIO(), io.BytesIO()
    Image.fromarray(images.to_8_bit(noise[:8, :8])).save(small, "JPEG")
    exif = b"Exif\0\0" + small.getvalue()
    picture = Image.fromarray(images.to_8_bit(noise))
    picture.save(photograph, "JPEG", exif=exif, progressive=progressive)
    content, file = photograph.getvalue(), tmp_path / "a.jpg"
    file.write_bytes(content + bytes(100))
    assert images.decode(file).pixels.shape == noise.shape
    file.write_bytes(content[:-500] + bytes(500))
    for read in (images.decode, lambda path: images.thumbnail(path, 16)):
        with pytest.raises(ImageError, match=r"a\.jpg: unreadable or truncated"):
            read(file)


def test_shrinking_is_pillows_antialiased_bicubic(noise: images.ImageArray) -> None:
    small = images.resize(noise, 12, 8)
    for c in range(3):
        band = Image.fromarray(noise[..., c]).resize((12, 8), Image.Resampling.BICUBIC)
        assert np.abs(small[..., c] - np.asarray(band)).max() < 5e-5


def transparent(mode: str) -> Image.Image:
    """Grey 100 over a left third of alpha 0 and a right third of alpha 102 (0.4)."""
    alpha = np.full((40, 60), 255, np.uint8)
    alpha[:, :20], alpha[:, 40:] = 0, 102
    grey = np.full((40, 60), 100, np.uint8)
    image = Image.fromarray(np.dstack([grey, grey, grey, alpha]))
    if mode == "P":
        indexed = Image.fromarray(np.searchsorted([0, 102, 255], alpha).astype(np.uint8), "P")
        indexed.putpalette([100] * 9)
        indexed.info["transparency"] = bytes([0, 102, 255])
        return indexed
    return image.convert(mode)


@pytest.mark.parametrize(
    ("suffix", "mode"),
    [
        *[("png", mode) for mode in ("RGBA", "LA", "P")],
        ("tif", "RGBA"),
        ("webp", "RGBA"),
        ("heic", "RGBA"),
    ],
)
def test_alpha_is_apart_from_colour(tmp_path: Path, suffix: str, mode: str) -> None:
    options = SAVED[suffix] | ({"exact": True} if suffix == "webp" else {})
    transparent(mode).save(tmp_path / f"a.{suffix}", **options)
    picture = images.decode(tmp_path / f"a.{suffix}")
    assert picture.alpha is not None
    assert np.abs(np.unique(picture.alpha) - [0, 0.4, 1]).max() < 1e-6
    assert (picture.alpha[:, :20] == 0).all()
    grey = np.float32(100) / np.float32(255)
    assert np.abs(picture.pixels - grey).max() < 1e-6
    background = np.array([0, 0.5, 1])
    read = images.read(tmp_path / f"a.{suffix}", background.tolist())
    assert np.abs(read[:, :20] - background).max() == 0
    assert np.abs(read[:, 20:40] - grey).max() < 1e-6
    assert np.abs(read[:, 40:] - (0.4 * grey + 0.6 * background)).max() < 1e-6


@pytest.mark.parametrize("mode", ["L", "RGB"])
def test_the_transparent_colour_of_a_png(tmp_path: Path, mode: str) -> None:
    image = Image.new(mode, (60, 40), "white")
    image.paste("black", (0, 0, 20, 40))
    image.save(tmp_path / "a.png", transparency=0 if mode == "L" else (0, 0, 0))
    picture = images.decode(tmp_path / "a.png")
    assert picture.alpha is not None
    assert (picture.alpha[:, :20] == 0).all()
    assert (picture.alpha[:, 20:] == 1).all()


def test_premultiplied_colours_of_a_tiff_are_divided(tmp_path: Path) -> None:
    stored = np.asarray(transparent("RGBA")).copy()
    stored[..., :3] = np.round(stored[..., :3] * (stored[..., 3:] / 255))
    tifffile.imwrite(tmp_path / "a.tif", stored, photometric="rgb", extrasamples=["assocalpha"])
    picture = images.decode(tmp_path / "a.tif")
    assert np.abs(picture.pixels[:, 20:] * 255 - 100).max() <= 1.3
    assert np.abs(images.read(tmp_path / "a.tif")[:, 40:] * 255 - 40).max() <= 0.6


@pytest.mark.parametrize("suffix", ["tif", "png", "mpo"])
def test_of_several_images_the_first_is_read_and_said(tmp_path: Path, suffix: str) -> None:
    """But for a JPEG's: phones add gain maps and depth."""
    first, other = (Image.new("RGB", (60, 40), colour) for colour in ("white", "black"))
    options = {"mpo": {}}.get(suffix) or SAVED.get(suffix, {})
    first.save(tmp_path / f"a.{suffix}", save_all=True, append_images=[other], **options)
    picture = images.decode((tmp_path / f"a.{suffix}").rename(tmp_path / "b.jpg"))
    assert picture.pixels.min() == 1
    several = ("only the first image of the file read",)
    assert picture.notes == (() if suffix == "mpo" else several)


@pytest.mark.parametrize(
    ("content", "name"),
    [
        (b"\0\0\0\x0cJXL \r\n\x87\n", "JPEG XL"),
        (b"GIF89a" + bytes(20), "GIF"),
    ],
)
def test_a_format_that_is_not_read_is_named(tmp_path: Path, content: bytes, name: str) -> None:
    (tmp_path / "a.jpg").write_bytes(content)
    with pytest.raises(ImageError, match=rf"a\.jpg: it is {name}, which is not read; convert it"):
        images.size(tmp_path / "a.jpg")


def test_heic_without_its_package_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pillow_heif", None)
    (tmp_path / "a.heic").write_bytes(b"\0\0\0\x18ftypheic" + bytes(100))
    with pytest.raises(ImageError, match=r"a\.heic: .*pip install 'xrgs\[heic\]'"):
        images.size(tmp_path / "a.heic")


def test_heic_is_read_with_its_camera(tmp_path: Path) -> None:
    tags = Image.Exif()
    tags[0x010F] = "Maker"
    Image.new("RGB", (60, 40)).save(tmp_path / "a.heic", exif=tags.tobytes())
    assert exif_of.read(tmp_path / "a.heic").camera == "Maker"


def test_an_encapsulated_postscript_program_is_not_run(tmp_path: Path) -> None:
    file = tmp_path / "a.png"
    Image.new("RGB", (9, 9)).save(file, "EPS")
    with pytest.raises(ImageError, match=r"a\.png"):
        images.read(file)


def bitmap(width: int, height: int) -> bytes:
    """A BMP of one pixel whose header declares this size."""
    stream = io.BytesIO()
    Image.new("RGB", (1, 1)).save(stream, "BMP")
    content = stream.getvalue()
    return content[:18] + width.to_bytes(4, "little") + height.to_bytes(4, "little") + content[26:]


def test_a_photograph_of_200_megapixels_is_admitted_and_a_larger_one_refused(
    tmp_path: Path,
) -> None:
    zeros = bytes(1_000_000)  # enough for the sizes, if they compressed as no photograph does
    (tmp_path / "a.bmp").write_bytes(bitmap(16_320, 12_240) + zeros)
    assert images.size(tmp_path / "a.bmp") == (16_320, 12_240)
    (tmp_path / "a.bmp").write_bytes(bitmap(1 << 14, 1 << 14) + zeros)
    assert images.size(tmp_path / "a.bmp") == (1 << 14, 1 << 14)
    for width, height in ((1 << 14, (1 << 14) + 1), (1 << 16, 1 << 16)):  # Pillow refuses this one
        (tmp_path / "a.bmp").write_bytes(bitmap(width, height) + zeros)
        for reader in (images.size, images.read):
            with pytest.raises(ImageError, match=r"a\.bmp: "):
                reader(tmp_path / "a.bmp")


@pytest.mark.parametrize(
    ("mode", "form", "why"),
    [("RGB", "WEBP", "cannot identify"), ("P", "PNG", "not 8-bit"), ("RGBA", "PNG", "not 8-bit")],
)
def test_images_of_stores_are_pngs_of_8_bit_rgb_pixels_alone(
    tmp_path: Path, mode: str, form: str, why: str
) -> None:
    Image.new(mode, (9, 9)).save(tmp_path / "a.png", form)
    assert images.read(tmp_path / "a.png").shape == (9, 9, 3)
    with pytest.raises(ImageError, match=rf"a\.png: .*{why}"):
        images.read_png(tmp_path / "a.png")


def test_a_file_that_cant_be_read_now_is_not_called_damaged(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """At once, or in the middle of its content."""
    file = tmp_path / "a.png"
    Image.linear_gradient("L").convert("RGB").save(file)
    content = file.read_bytes()
    failure = OSError(errno.EIO, os.strerror(errno.EIO))

    class Sick(io.BytesIO):
        def read(self, size: int | None = -1, /) -> bytes:
            if self.tell() > 60:
                raise failure
            return super().read(size)

    for opened in (lambda *_: Sick(content), Mock(side_effect=failure)):
        monkeypatch.setattr(Path, "open", opened)
        for reader in (images.read, images.read_png):
            with pytest.raises(UnreadableError, match=r"a\.png: Input/output error; try again"):
                reader(file)


def test_a_large_photograph_has_the_bytes_for_its_pixels(tmp_path: Path) -> None:
    """A header alone does not make this process take the memory of the image it declares."""
    (tmp_path / "a.bmp").write_bytes(bitmap(16_000, 16_000))
    tracemalloc.start()
    with pytest.raises(ImageError, match=r"a\.bmp: .*58 bytes are too few for 16000 x 16000 px"):
        images.read(tmp_path / "a.bmp")
    assert tracemalloc.get_traced_memory()[1] < 10_000_000
    tracemalloc.stop()
