from __future__ import annotations

import io
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from PIL import Image
from scipy import ndimage

from tests.conftest import composed
from xrgs.mixture.degradations import DEGRADATIONS, resolve_degradation


def degraded(how: str, high: np.ndarray, seed: int = 0, **phone: Any) -> np.ndarray:
    """The LR view, with changes of `variant.phone`."""
    conf = composed().variant
    conf = replace(conf, phone=replace(conf.phone, **phone))
    return DEGRADATIONS[how].function(high, conf, np.random.default_rng(seed))


@pytest.fixture
def photo() -> np.ndarray:
    """Smooth colour under fine noise."""
    rng = np.random.default_rng(0)
    ramp = np.linspace(0.2, 0.8, 100, dtype=np.float32)
    smooth = np.stack(np.broadcast_arrays(ramp[None], ramp[:80, None], np.float32(0.5)), -1)
    return (smooth + rng.normal(0, 0.1, smooth.shape)).clip(0, 1).astype(np.float32)


def test_auto_degrades_views_drawn_at_random_and_no_others() -> None:
    conf = composed().variant
    kinds = {
        tags: resolve_degradation(replace(conf, tags=tags, degradation="auto"))
        for tags in ("flag", "megapixels", "distance", "sampling_rate")
    }
    assert kinds.pop("flag") == "downsample"
    assert set(kinds.values()) == {"none"}
    assert resolve_degradation(replace(conf, tags="distance", degradation="jpeg")) == "jpeg"


def test_digital_zoom_is_the_small_copy_enlarged(photo: np.ndarray) -> None:
    small = degraded("downsample", photo)
    zoomed = degraded("digital_zoom", photo)
    assert small.shape == (16, 20, 3)
    assert zoomed.shape == photo.shape
    for c in range(3):  # PIL's bicubic as the other implementation
        band = Image.fromarray(np.ascontiguousarray(photo[..., c]))
        for size in ((20, 16), (100, 80)):
            band = band.resize(size, Image.Resampling.BICUBIC)
        assert np.abs(zoomed[..., c] - np.asarray(band)).max() < 1e-4


def test_jpeg_is_what_pillows_encoder_gives(photo: np.ndarray) -> None:
    stream = io.BytesIO()
    pixels = Image.fromarray(np.round(photo * 255).astype(np.uint8))
    pixels.save(stream, "JPEG", quality=10, subsampling=2)
    expected = np.asarray(Image.open(stream), dtype=np.float32) / np.float32(255)
    found = degraded("jpeg", photo)
    assert np.array_equal(found, expected)


def test_box_is_the_mean_of_a_pixels_area(photo: np.ndarray) -> None:
    expected = ndimage.uniform_filter(photo.astype(np.float64), (5, 5, 0))[2::5, 2::5]
    assert np.abs(degraded("box", photo) - expected).max() < 1e-7


def test_lanczos_is_the_windowed_sinc_at_the_small_copys_pixels(photo: np.ndarray) -> None:
    """Weights sinc(x) sinc(x / 3), |x| < 3 LR px, normalised over the pixels that there are."""

    def matrix(old: int, new: int) -> np.ndarray:
        centres, pixels = np.arange(new) * 5 + 2.5, np.arange(old) + 0.5
        x = (pixels - centres[:, None]) / 5
        weights = np.where(np.abs(x) < 3, np.sinc(x) * np.sinc(x / 3), 0)
        normalised: np.ndarray = weights / weights.sum(1, keepdims=True)
        return normalised

    expected = np.einsum(
        "ih,hwc,jw->ijc", matrix(80, 16), photo.astype(np.float64), matrix(100, 20)
    )
    assert np.abs(degraded("lanczos", photo) - expected).max() < 1e-5


def test_phone_without_noise_is_a_blurred_box_through_jpeg(photo: np.ndarray) -> None:
    """The blur by numpy's FFT, with a Gaussian of 0.8 x 5 HR px."""
    width = 16  # px, four standard deviations
    taps = np.exp(-0.5 * (np.arange(-width, width + 1) / 4.0) ** 2)
    kernel = np.outer(taps, taps)[..., None] / taps.sum() ** 2
    padded = np.pad(photo.astype(np.float64), ((width, width), (width, width), (0, 0)), "symmetric")
    image, blur = (np.fft.rfft2(of, padded.shape[:2], axes=(0, 1)) for of in (padded, kernel))
    blurred = np.fft.irfft2(image * blur, padded.shape[:2], axes=(0, 1))
    expected = degraded("box", blurred[2 * width :, 2 * width :].astype(np.float32))
    found = degraded("phone", photo, noise=0.0, jpeg_quality=95)
    assert np.abs(found - expected).mean() < 0.01
    stream = io.BytesIO()
    Image.fromarray(np.round(expected * 255).astype(np.uint8)).save(stream, "JPEG", quality=75)
    compressed = np.asarray(Image.open(stream), np.float64) / 255
    assert np.abs(degraded("phone", photo, noise=0.0) - compressed).max() <= 2 / 255


def test_phones_noise_has_its_standard_deviation_in_each_channel() -> None:
    grey = np.full((500, 500, 3), 0.5, np.float32)
    for noise in (5.0, 10.0):  # quality 95 keeps the luma's noise, if it is not small
        found = degraded("phone", grey, noise=noise, jpeg_quality=95) * 255 - 127.5
        luma = found @ [0.299, 0.587, 0.114]
        expected = noise * np.sqrt(0.299**2 + 0.587**2 + 0.114**2)
        assert luma.std() == pytest.approx(expected, rel=0.1)
    assert np.array_equal(degraded("phone", grey, seed=3), degraded("phone", grey, seed=3))
    assert not np.array_equal(degraded("phone", grey, seed=3), degraded("phone", grey, seed=4))
