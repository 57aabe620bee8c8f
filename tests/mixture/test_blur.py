"""How blurry LR photographs are: views of a known blur, synthetic and real."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from xrgs.config import VariantConf
from xrgs.mixture.blur import blur_notes, lr_blur
from xrgs.mixture.degradations import DEGRADATIONS
from xrgs.mixture.views import View
from xrgs.photos import images

Save = Callable[..., View]
Make = Callable[..., VariantConf]
FACTOR = 4
#: The sigma of the mean over a pixel's area, LR px; of 4 x 4 px, (1 - 1 / 16) / 12 is the square.
BOX = np.sqrt((1 - 1 / 16) / 12)


def estimated(views: Sequence[View]) -> float:
    """The blur of views from which it can be estimated."""
    blur = lr_blur(views)
    assert blur is not None
    return blur


@cache
def texture(seed: int, height: int = 320, width: int = 400) -> np.ndarray:
    """A random image whose power falls by the square of the frequency, as of photographs."""
    white = np.random.default_rng(seed).normal(size=(height, width))
    frequency = np.hypot(np.fft.fftfreq(height)[:, None], np.fft.fftfreq(width))
    frequency[0, 0] = np.inf
    image = np.fft.ifft2(np.fft.fft2(white) / frequency).real
    image = 0.5 + 0.15 * image / image.std()
    return np.repeat(image[..., None], 3, axis=2).clip(0, 1).astype(np.float32)


@pytest.fixture
def save(tmp_path: Path) -> Save:
    """(image, tag, rho) -> the training view of an image, on disk."""

    def saved(image: np.ndarray, tag: str, rho: float) -> View:
        file = tmp_path / f"{len([*tmp_path.iterdir()])}.png"
        images.save(file, image)
        height, width = image.shape[:2]
        return View(file.stem, file, "train", tag, width, height, np.eye(3), np.eye(4), rho)

    return saved


@pytest.fixture
def views_of(save: Save, configured: Make) -> Callable[..., list[View]]:
    """(HR images, images to degrade, degradation, **phone) -> the views of such a variant."""
    conf = configured(factor=FACTOR)

    def views(
        high: Sequence[np.ndarray], low: Sequence[np.ndarray], how: str, **phone: float
    ) -> list[View]:
        changed = replace(conf, phone=replace(conf.phone, **phone))  # type: ignore[arg-type]
        made = [
            DEGRADATIONS[how].function(image, changed, np.random.default_rng(i))
            for i, image in enumerate(low)
        ]
        return [save(h, "HR", 1.0) for h in high] + [save(m, "LR", 1 / FACTOR) for m in made]

    return views


@pytest.mark.slow
@pytest.mark.parametrize(
    ("sigma", "noise", "quality"), [(0.0, 2.0, 75), (0.5, 0.0, 95), (0.8, 2.0, 75), (1.2, 2.0, 75)]
)
def test_a_known_blur_is_found_through_noise_and_jpeg(
    views_of: Callable[..., list[View]], sigma: float, noise: float, quality: int
) -> None:
    """HR and LR views show different textures. A blur adds its square to a pixel's box's."""
    high, low = [texture(seed) for seed in range(3)], [texture(seed) for seed in range(3, 9)]
    views = views_of(high, low, "phone", blur=sigma, noise=noise, jpeg_quality=quality)
    found = estimated(views)
    expected = np.hypot(sigma, BOX)
    # The fit finds the square, so that a small sigma is less certain. A blur of 1.2 px leaves
    # little but noise above 0.25 cycles / px, which looks sharper.
    assert found**2 == pytest.approx(expected**2, abs=0.07, rel=0.1 if sigma < 1 else 0.25)
    assert len(blur_notes(found)) == (expected > 0.5)


@pytest.mark.slow
def test_sharp_kernels_are_not_called_blurry(views_of: Callable[..., list[View]]) -> None:
    high, low = [texture(seed) for seed in range(3)], [texture(seed) for seed in range(3, 9)]
    found = {how: estimated(views_of(high, low, how)) for how in ("downsample", "lanczos", "box")}
    assert 0 <= found["lanczos"] <= found["box"] < 0.3
    assert found["downsample"] < 0.3
    assert not any(blur_notes(blur) for blur in found.values())


def test_without_both_classes_or_enough_pixels_nothing_is_said(
    views_of: Callable[..., list[View]],
) -> None:
    views = views_of([texture(0)], [texture(1)], "phone")
    for tag in ("HR", "LR"):
        assert lr_blur([view for view in views if view.tag == tag]) is None
    small = views_of([texture(0, 120, 160)], [texture(1, 120, 160)], "phone")
    assert lr_blur(small) is None  # LR views of 40 x 30 px
    assert blur_notes(None) == []


@pytest.mark.slow
@pytest.mark.parametrize(
    ("scene", "how", "expected"),
    [("fern", "downsample", None), ("horns", "box", None), ("fern", "phone", 0.85)],
)
def test_on_photographs_a_phones_blur_is_found_and_no_other(
    views_of: Callable[..., list[View]],
    data_root: Path,
    scene: str,
    how: str,
    expected: float | None,
) -> None:
    files = sorted((data_root / "llff" / scene).glob("images*/*"))[:9]
    photographs = [images.resize(images.read(file), 500, 376) for file in files]
    blur = estimated(views_of(photographs[:3], photographs[3:], how))
    if expected is None:
        assert blur < 0.4
        assert blur_notes(blur) == []
    else:
        assert blur == pytest.approx(expected, abs=0.06)
        (note,) = blur_notes(blur)
        assert f"by a Gaussian of {blur:.2f} px" in note
