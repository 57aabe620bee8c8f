from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pillow_heif
import pytest
from PIL import Image

from xrgs.capture import images
from xrgs.capture.images import ImageError


@pytest.fixture
def noise() -> images.ImageArray:
    return np.random.default_rng(0).random((40, 60, 3), dtype=np.float32)


def test_a_saved_image_is_read_to_half_a_step(tmp_path: Path, noise: images.ImageArray) -> None:
    images.save(tmp_path / "new" / "a.png", noise * 1.2 - 0.1)
    read = images.read(tmp_path / "new" / "a.png")
    assert read.dtype == np.float32
    assert np.abs(read - np.clip(noise * 1.2 - 0.1, 0, 1)).max() <= 0.5 / 255 + 1e-6


@pytest.mark.parametrize(("orientation", "turns"), [(1, 0), (6, -1), (3, 2), (8, 1)])
def test_exif_orientation_is_applied_to_image_and_size(
    tmp_path: Path, noise: images.ImageArray, orientation: int, turns: int
) -> None:
    stored = Image.fromarray((noise * 255).astype(np.uint8))
    exif = Image.Exif()
    exif[0x0112] = orientation
    stored.save(tmp_path / "a.png", exif=exif)
    read = images.read(tmp_path / "a.png")
    expected = np.rot90(np.asarray(stored), turns).astype(np.float32) / 255
    assert np.array_equal(read, expected)
    assert images.size(tmp_path / "a.png") == (read.shape[1], read.shape[0])


@pytest.mark.parametrize("mode", ["L", "LA", "P", "RGBA", "1", "CMYK"])
def test_any_8_bit_photograph_is_read_as_rgb(tmp_path: Path, mode: str) -> None:
    Image.new(mode, (20, 10)).save(tmp_path / "a.tif")
    assert images.read(tmp_path / "a.tif").shape == (10, 20, 3)


def test_the_camera_is_read_from_exif(tmp_path: Path) -> None:
    Image.new("RGB", (20, 10)).save(tmp_path / "no_exif.jpg")
    assert images.exif_camera(tmp_path / "no_exif.jpg") == ""
    exif = Image.Exif()
    exif[0x010F], exif[0x0110] = "Maker ", "X 100"
    exif.get_ifd(0x8769)[0x920A] = 23.0
    Image.new("RGB", (20, 10)).save(tmp_path / "exif.jpg", exif=exif)
    assert images.exif_camera(tmp_path / "exif.jpg") == "Maker/X 100/23.0"
    (tmp_path / "no.jpg").write_text("hello")
    with pytest.raises(ImageError, match=r"no\.jpg"):
        images.exif_camera(tmp_path / "no.jpg")


def test_a_truncated_file_is_named(tmp_path: Path, noise: images.ImageArray) -> None:
    images.save(tmp_path / "a b.png", noise)
    whole = (tmp_path / "a b.png").read_bytes()
    (tmp_path / "a b.png").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(ImageError, match=r"a b\.png: unreadable or truncated"):
        images.read(tmp_path / "a b.png")


def test_a_file_that_is_no_image_is_named(tmp_path: Path) -> None:
    (tmp_path / "a.png").write_text("hello")
    with pytest.raises(ImageError, match=r"a\.png"):
        images.read(tmp_path / "a.png")
    with pytest.raises(ImageError, match=r"a\.png"):
        images.size(tmp_path / "a.png")


def test_16_bit_pixels_are_refused_rather_than_clipped(tmp_path: Path) -> None:
    Image.fromarray(np.full((9, 9), 40_000, np.uint16)).save(tmp_path / "a.png")
    with pytest.raises(ImageError, match="8 bits"):
        images.read(tmp_path / "a.png")


def test_shrinking_is_pillows_antialiased_bicubic(noise: images.ImageArray) -> None:
    small = images.resize(noise, 12, 8)
    for c in range(3):
        band = Image.fromarray(noise[..., c]).resize((12, 8), Image.Resampling.BICUBIC)
        assert np.abs(small[..., c] - np.asarray(band)).max() < 5e-5


def test_resizing_to_the_same_size_changes_nothing(noise: images.ImageArray) -> None:
    assert images.resize(noise, 60, 40) is noise


@pytest.mark.parametrize(("orientation", "turns"), [(1, 0), (6, -1)])
def test_heic_is_read_upright(
    tmp_path: Path, noise: images.ImageArray, orientation: int, turns: int
) -> None:
    stored = Image.fromarray((noise * 255).astype(np.uint8))
    exif = Image.Exif()
    exif[0x0112], exif[0x010F] = orientation, "Maker"
    heif = pillow_heif.from_pillow(stored)
    lossless = {"quality": -1, "chroma": 444, "matrix_coefficients": 0}
    heif.save(tmp_path / "a.heic", **lossless, exif=exif.tobytes())
    read = images.read(tmp_path / "a.heic")
    expected = np.rot90(np.asarray(stored), turns)
    assert np.array_equal(np.round(read * 255), expected)
    assert images.size(tmp_path / "a.heic") == (expected.shape[1], expected.shape[0])
    assert images.exif_camera(tmp_path / "a.heic") == "Maker"


def test_heic_without_its_package_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pillow_heif", None)
    (tmp_path / "a.heic").write_bytes(b"\0\0\0\x18ftypheic" + bytes(100))
    with pytest.raises(ImageError, match=r"a\.heic: .*pip install 'xrgs\[heic\]'"):
        images.size(tmp_path / "a.heic")
