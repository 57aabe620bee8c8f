from __future__ import annotations

import io
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from xrgs.capture.degradations import DEGRADATIONS, resolve_degradation
from xrgs.composing import compose

CONF = compose("variant.degradation=downsample").variant


@pytest.fixture
def photo() -> np.ndarray:
    """Smooth colour under fine noise."""
    rng = np.random.default_rng(0)
    ramp = np.linspace(0.2, 0.8, 100, dtype=np.float32)
    smooth = np.stack(np.broadcast_arrays(ramp[None], ramp[:80, None], np.float32(0.5)), -1)
    return (smooth + rng.normal(0, 0.1, smooth.shape)).clip(0, 1).astype(np.float32)


def test_auto_degrades_views_drawn_at_random_and_no_others() -> None:
    kinds = {
        tags: resolve_degradation(replace(CONF, tags=tags, degradation="auto"))
        for tags in ("flag", "megapixels", "distance", "sampling_rate")
    }
    assert kinds.pop("flag") == "downsample"
    assert set(kinds.values()) == {"none"}
    assert resolve_degradation(replace(CONF, tags="distance", degradation="jpeg")) == "jpeg"


def test_digital_zoom_is_the_small_copy_enlarged(photo: np.ndarray) -> None:
    small = DEGRADATIONS["downsample"](photo, CONF)
    zoomed = DEGRADATIONS["digital_zoom"](photo, CONF)
    assert small.shape == (16, 20, 3)
    assert zoomed.shape == photo.shape
    for c in range(3):  # PIL's bicubic as the other implementation
        band = Image.fromarray(np.ascontiguousarray(photo[..., c]))
        for size in ((20, 16), (100, 80)):
            band = band.resize(size, Image.Resampling.BICUBIC)
        assert np.abs(zoomed[..., c] - np.asarray(band)).max() < 1e-4


def test_digital_zoom_keeps_what_is_coarse_and_nothing_finer(photo: np.ndarray) -> None:
    """Of the power beyond twice the small copy's Nyquist frequency, bicubic leaves a few %."""
    zoomed = DEGRADATIONS["digital_zoom"](photo, CONF)
    power = [np.abs(np.fft.fft2(p[..., 1] - p[..., 1].mean())) ** 2 for p in (photo, zoomed)]
    fine = np.maximum(*np.abs(np.meshgrid(np.fft.fftfreq(100), np.fft.fftfreq(80)))) > 0.2
    coarse = ~fine
    assert power[1][fine].sum() < 0.1 * power[0][fine].sum()
    assert power[1][coarse].sum() > 0.5 * power[0][coarse].sum()


def test_jpeg_is_what_pillows_encoder_gives(photo: np.ndarray) -> None:
    stream = io.BytesIO()
    pixels = Image.fromarray(np.round(photo * 255).astype(np.uint8))
    pixels.save(stream, "JPEG", quality=10, subsampling=2)
    expected = np.asarray(Image.open(stream), dtype=np.float32) / np.float32(255)
    found = DEGRADATIONS["jpeg"](photo, CONF)
    assert np.array_equal(found, expected)


def test_jpeg_loses_more_at_lower_quality(photo: np.ndarray) -> None:
    grey = np.repeat(photo.mean(-1, keepdims=True), 3, -1)  # colour noise is lost at any quality
    confs = [replace(CONF, jpeg_quality=quality) for quality in (5, 20, 60, 95)]
    errors = [np.abs(DEGRADATIONS["jpeg"](grey, conf) - grey).mean() for conf in confs]
    assert errors == sorted(errors, reverse=True)
    assert errors[0] > 2 * errors[-1] > 0
