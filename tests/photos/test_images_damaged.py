"""Photographs that are refused by name, within bounds of memory; test_fuzz has damaged ones."""

from __future__ import annotations

import errno
import io
import os
import tracemalloc
import zlib
from pathlib import Path
from unittest.mock import Mock

import pytest
from PIL import Image

from xrgs.errors import UnreadableError
from xrgs.photos import images
from xrgs.photos.images import ImageError


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
