from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from xrgs.capture import images
from xrgs.capture.images import ImageError, Lens

LENS = Lens(100, 80, 90.0, 90.0, 50.0, 40.0)


@pytest.fixture
def noise() -> np.ndarray:
    return np.random.default_rng(0).random((40, 60, 3), dtype=np.float32)


def test_what_was_saved_is_read_to_half_a_step(tmp_path: Path, noise: np.ndarray) -> None:
    images.save(tmp_path / "new" / "a.png", noise * 1.2 - 0.1)
    read = images.read(tmp_path / "new" / "a.png")
    assert read.dtype == np.float32
    assert np.abs(read - np.clip(noise * 1.2 - 0.1, 0, 1)).max() <= 0.5 / 255 + 1e-6


@pytest.mark.parametrize(("orientation", "turns"), [(1, 0), (6, -1), (3, 2), (8, 1)])
def test_exif_orientation_is_applied_to_image_and_size(
    tmp_path: Path, noise: np.ndarray, orientation: int, turns: int
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


def test_exif_tells_the_camera_where_it_is_told(tmp_path: Path) -> None:
    Image.new("RGB", (20, 10)).save(tmp_path / "plain.jpg")
    assert images.camera_mark(tmp_path / "plain.jpg") == ""
    exif = Image.Exif()
    exif[0x010F], exif[0x0110] = "Maker ", "X 100"
    exif.get_ifd(0x8769)[0x920A] = 23.0
    Image.new("RGB", (20, 10)).save(tmp_path / "told.jpg", exif=exif)
    assert images.camera_mark(tmp_path / "told.jpg") == "Maker/X 100/23.0"
    (tmp_path / "no.jpg").write_text("hello")
    with pytest.raises(ImageError, match=r"no\.jpg"):
        images.camera_mark(tmp_path / "no.jpg")


def test_a_truncated_file_is_named(tmp_path: Path, noise: np.ndarray) -> None:
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


def test_shrinking_is_pillows_antialiased_bicubic(noise: np.ndarray) -> None:
    small = images.resize(noise, 12, 8)
    for c in range(3):
        band = Image.fromarray(noise[..., c]).resize((12, 8), Image.Resampling.BICUBIC)
        assert np.abs(small[..., c] - np.asarray(band)).max() < 5e-5


def test_resizing_to_the_same_size_changes_nothing(noise: np.ndarray) -> None:
    assert images.resize(noise, 60, 40) is noise


def test_a_lens_keeps_its_rays_when_its_image_is_resized() -> None:
    lens = Lens(100, 80, 90.0, 91.0, 48.0, 41.0, 0.05).at(20, 16)
    ray = np.array([0.2, -0.3, 1])
    big = Lens(100, 80, 90.0, 91.0, 48.0, 41.0, 0.05).K @ ray
    assert (lens.K @ ray)[:2] * 5 == pytest.approx(big[:2])
    assert lens.k == 0.05


@pytest.mark.parametrize("k", [-0.2, -0.02, 0.03, 0.15])
def test_straightening_sends_each_pixel_where_the_lens_sent_its_ray(k: float) -> None:
    """On an image whose red is x and green is y, the colours tell the source of each pixel."""
    lens = Lens(100, 80, 90.0, 90.0, 48.0, 41.0, k)
    x, y = np.meshgrid(np.arange(100) + 0.5, np.arange(80) + 0.5)
    image = np.stack([x / 100, y / 80, 0 * x], -1).astype(np.float32)
    out, K = images.straighten(image, lens), lens.straightened().K
    rays = np.stack([(x - K[0, 2]) / K[0, 0], (y - K[1, 2]) / K[1, 1]], -1)
    bent = rays * (1 + k * (rays**2).sum(-1, keepdims=True))
    expected = bent * 90 + (48, 41)
    inner = (slice(2, -2), slice(2, -2))  # a spline has no more data half a pixel from the border
    assert np.abs(out[..., :2] * (100, 80) - expected)[inner].max() < 0.02


@pytest.mark.parametrize("k", [-0.2, -0.02, 0.03, 0.15])
def test_the_straightened_view_fills_its_frame_and_no_more(k: float) -> None:
    lens = Lens(100, 80, 90.0, 90.0, 48.0, 41.0, k)
    flat = lens.straightened()
    assert (flat.width, flat.height, flat.k) == (100, 80, 0.0)
    t = np.linspace(0, 1, 1001)
    border = np.concatenate(
        [np.stack(p, -1) for p in ((t, 0 * t), (t, 0 * t + 1), (0 * t, t), (0 * t + 1, t))]
    )
    rays = (border * (100, 80) - (48, 41)) / flat.fx
    source = rays * (1 + k * (rays**2).sum(-1, keepdims=True)) * 90 + (48, 41)
    outside = np.maximum(-source, source - (100, 80)).max()
    assert -0.01 < outside < 1e-3
    assert (flat.fx > 90) == (k > 0)


def test_a_strong_barrel_lens_does_not_fold_the_picture() -> None:
    """Its formula turns back at r² = 1/(3 · 0.9): no pixel of the view may come from beyond."""
    lens = Lens(100, 80, 60.0, 60.0, 50.0, 40.0, -0.9)
    flat = lens.straightened()
    corner = np.array([0.0, 0.0])
    r2 = (((corner - (50, 40)) / flat.fx) ** 2).sum()
    assert r2 < 1 / (3 * 0.9)
    source = corner - (50, 40)
    source = source / flat.fx * (1 - 0.9 * r2) * 60 + (50, 40)
    assert (source >= 0).all()
    assert (source <= (100, 80)).all()


def test_an_image_and_its_copy_are_straightened_by_one_zoom() -> None:
    lens = Lens(100, 80, 90.0, 90.0, 48.0, 41.0, -0.1)
    assert lens.at(20, 16).straightened().fx * 5 == pytest.approx(lens.straightened().fx)


def test_a_pinhole_photograph_is_left_alone(noise: np.ndarray) -> None:
    lens = Lens(60, 40, 50.0, 50.0, 30.0, 20.0)
    assert images.straighten(noise, lens) is noise
    with pytest.raises(ValueError, match="lens"):
        images.straighten(noise, LENS)
