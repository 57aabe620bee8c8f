"""Damaged photographs: they are read, or refused by their name, within bounds of memory."""

from __future__ import annotations

import errno
import io
import os
import tracemalloc
import zlib
from contextlib import suppress
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pillow_heif
import pytest
import tifffile
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from PIL import Image

from tests.photos.made_files import DISPLAY_P3, SRGB, png, profile
from xrgs.errors import UnreadableError
from xrgs.photos import exif, images
from xrgs.photos.images import ImageError

pillow_heif.register_heif_opener()
FAST = settings(max_examples=100, suppress_health_check=[HealthCheck.function_scoped_fixture])
#: A change of valid bytes: where (as a fraction), how many are replaced, and by what.
CHANGES = st.tuples(st.floats(0, 1), st.integers(0, 40), st.binary(max_size=12))


def changed(content: bytes, change: tuple[float, int, bytes]) -> bytes:
    fraction, count, new = change
    start = int(fraction * len(content))
    return content[:start] + new + content[start + count :]


def photograph(kind: str) -> bytes:
    stream = io.BytesIO()
    exif = Image.Exif()
    exif[0x0112], exif[0x0110] = 6, "a camera"
    picture = Image.linear_gradient("L").resize((40, 30)).convert("RGB")
    picture.save(stream, kind, exif=exif.tobytes(), icc_profile=profile("p", 2.2, DISPLAY_P3))
    return stream.getvalue()


def deep_tiff() -> bytes:
    stream = io.BytesIO()
    ramp = np.linspace(0, 65535, 30 * 40 * 3).astype(np.uint16).reshape(30, 40, 3)
    tifffile.imwrite(stream, ramp, photometric="rgb", compression="lzw", iccprofile=SRGB)
    return stream.getvalue()


PHOTOGRAPHS = {kind: photograph(kind) for kind in ("PNG", "JPEG", "TIFF", "WEBP", "HEIF")} | {
    "PNG of 16 bits": png(
        np.linspace(0, 65535, 30 * 40 * 4).reshape(30, 40, 4),
        (b"gAMA", (100_000).to_bytes(4, "big")),
        (b"sBIT", bytes([12] * 4)),
        (b"cICP", bytes([12, 13, 0, 1])),
    ),
    "TIFF of 16 bits": deep_tiff(),
}


@FAST
@given(kind=st.sampled_from(sorted(PHOTOGRAPHS)), change=CHANGES)
def test_a_damaged_photograph_is_read_or_refused(tmp_path: Path, kind: str, change: Any) -> None:
    file = tmp_path / "a.png"
    file.write_bytes(changed(PHOTOGRAPHS[kind], change))
    for reader in (images.size, exif.read, images.read, images.read_png):
        try:
            reader(file)
        except ImageError as error:
            assert str(file) in str(error)  # noqa: PT017 - or it is read
    with suppress(ImageError):
        assert images.decode(file).pixels.shape[1::-1] == images.size(file)


def test_an_encapsulated_postscript_program_is_not_run(tmp_path: Path) -> None:
    file = tmp_path / "a.png"
    Image.new("RGB", (9, 9)).save(file, "EPS")
    with pytest.raises(ImageError, match=r"a\.png"):
        images.read(file)


def declared(width: int, height: int) -> bytes:
    """A PNG of one pixel whose header declares this size."""
    stream = io.BytesIO()
    Image.new("L", (1, 1)).save(stream, "PNG")
    content = stream.getvalue()
    size = width.to_bytes(4, "big") + height.to_bytes(4, "big")
    head = b"IHDR" + size + content[24:29]
    return content[:12] + head + zlib.crc32(head).to_bytes(4, "big") + content[33:]


def test_an_image_that_declares_too_many_pixels_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.png").write_bytes(declared(1 << 20, 1 << 20))
    for reader in (images.size, images.read):
        with pytest.raises(ImageError, match=r"a\.png.*decompression bomb"):
            reader(tmp_path / "a.png")


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
    (tmp_path / "a.bmp").write_bytes(bitmap(1 << 14, (1 << 14) + 1) + zeros)
    for reader in (images.size, images.read):
        with pytest.raises(ImageError, match=r"a\.bmp: "):
            reader(tmp_path / "a.bmp")


def test_images_of_stores_are_pngs_alone(tmp_path: Path) -> None:
    file = tmp_path / "a.png"
    Image.new("RGB", (9, 9)).save(file, "WEBP")
    assert images.read(file).shape == (9, 9, 3)
    with pytest.raises(ImageError, match=r"a\.png: .*cannot identify"):
        images.read_png(file)


@pytest.mark.parametrize("mode", ["P", "RGBA"])
def test_images_of_stores_have_8_bit_rgb_pixels_alone(tmp_path: Path, mode: str) -> None:
    Image.new(mode, (9, 9)).save(tmp_path / "a.png")
    with pytest.raises(ImageError, match=r"a\.png: .*not 8-bit RGB"):
        images.read_png(tmp_path / "a.png")


def test_a_file_that_cant_be_read_now_is_not_called_damaged(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """At once, or in the middle of its content."""
    file = tmp_path / "a.png"
    file.write_bytes(PHOTOGRAPHS["PNG"])
    failure = OSError(errno.EIO, os.strerror(errno.EIO))

    class Sick(io.BytesIO):
        def read(self, size: int | None = -1, /) -> bytes:
            if self.tell() > 60:
                raise failure
            return super().read(size)

    for opened in (lambda *_: Sick(PHOTOGRAPHS["PNG"]), Mock(side_effect=failure)):
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
