"""The metrics against scikit-image, kornia and float64 closed forms."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.lib.stride_tricks import sliding_window_view
from torch import Tensor

from tests.splat.scenes import similar_pair
from xrgs.evaluation import metrics
from xrgs.evaluation.lpips import weights
from xrgs.photos import masks

#: Whether more of it is better, from the metrics' own papers and common sense, not from the code.
MORE_IS_BETTER = {
    "training_time_s": False,
    "render_time_ms": False,
    "gaussians": False,
    "memory_bytes": False,
    "peak_rss_bytes": False,
    "lpips": False,
    "ssim": True,
    "psnr": True,
    "psnr_pooled": True,
    "psnr_worst": True,
    "psnr_plain": True,
    "psnr_fitted": True,
    "lpips_vgg": False,
    "evaluations": False,
}


def pair(height: int = 40, width: int = 53) -> tuple[Tensor, Tensor]:
    first, second = similar_pair(height, width)
    return first.float(), second.float()


def ssim_map_by_definition(image: Tensor, target: Tensor) -> np.ndarray:
    """[H, W, 3] of Wang et al. 2004 in float64: 11 taps, sigma 1.5, range 1, borders mirrored."""
    taps = np.exp(-(np.arange(-5, 6) ** 2) / (2 * 1.5**2))
    window = np.outer(taps, taps) / taps.sum() ** 2

    def patches(x: Tensor) -> np.ndarray:
        padded = np.pad(x.double().numpy(), ((5, 5), (5, 5), (0, 0)), mode="reflect")
        return sliding_window_view(padded, (11, 11), axis=(0, 1))  # [H, W, 3, 11, 11]

    a, b = patches(image), patches(target)
    mean_a, mean_b = (np.einsum("hwcij,ij->hwc", x, window) for x in (a, b))
    da, db = a - mean_a[..., None, None], b - mean_b[..., None, None]
    var_a, var_b, cov = (
        np.einsum("hwcij,ij->hwc", product, window) for product in (da * da, db * db, da * db)
    )
    c1, c2 = 0.01**2, 0.03**2
    values: np.ndarray = (
        (2 * mean_a * mean_b + c1)
        * (2 * cov + c2)
        / ((mean_a**2 + mean_b**2 + c1) * (var_a + var_b + c2))
    )
    return values


def test_ssim_is_its_definition() -> None:
    image, target = pair()
    expected = ssim_map_by_definition(image, target).mean()
    assert 0.2 < expected < 0.9
    assert metrics.ssim(image, target) == pytest.approx(expected, abs=1e-6)
    assert metrics.ssim(image, image) == pytest.approx(1, abs=1e-6)


def test_ssim_differs_from_scikit_images_by_the_border_alone() -> None:
    from skimage.metrics import structural_similarity

    image, target = pair(200, 210)
    expected = structural_similarity(
        image.numpy(),
        target.numpy(),
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        data_range=1.0,
        channel_axis=-1,
    )
    assert metrics.ssim(image, target) == pytest.approx(expected, abs=5e-3)


def test_psnr_is_scikit_images_and_kornias() -> None:
    from kornia.metrics import psnr
    from skimage.metrics import peak_signal_noise_ratio

    image, target = pair()
    value = metrics.psnr(image, target)
    assert value == pytest.approx(
        peak_signal_noise_ratio(target.numpy().astype(float), image.numpy().astype(float)),
        rel=1e-12,
    )
    assert value == pytest.approx(psnr(image, target, 1.0).item(), rel=1e-6)
    flat = torch.full((12, 13, 3), 0.25)
    assert metrics.psnr(flat, flat + 0.5) == pytest.approx(20 * math.log10(2), rel=1e-12)
    assert metrics.psnr(torch.zeros(12, 13, 3), torch.ones(12, 13, 3)) == 0
    assert metrics.psnr(image, image) == math.inf


def test_lpips_is_the_networks_distance_where_there_are(
    random_weights: weights.Weights, monkeypatch: pytest.MonkeyPatch
) -> None:
    from xrgs.evaluation.lpips.network import distance

    image, target = pair()
    assert metrics.lpips(image, target) is None
    monkeypatch.setattr(weights, "load_published", lambda: random_weights)
    tensors = {name: torch.from_numpy(array) for name, array in random_weights.items()}
    value = metrics.VIEW_METRICS["lpips"](image, target, None)
    assert isinstance(value, float)
    assert value == distance(image, target, tensors).item() > 0.01
    # The network shrinks an image to nothing: a cell of tiny views is no failed cell.
    assert metrics.lpips(*pair(30, 53)) is None


def test_directions_are_true(
    random_weights: weights.Weights, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A worse image scores on the worse side."""
    monkeypatch.setattr(weights, "load_published", lambda: random_weights)
    image, target = pair()
    better_high = {metric.name: metric.higher_is_better for metric in metrics.METRICS}
    assert better_high == MORE_IS_BETTER
    for metric in metrics.METRICS:
        if metric.score is not None and metric.name not in {"lpips_vgg", "psnr_plain"}:
            near = metric.score(target + 0.1 * (image - target), target, None)
            far = metric.score(image, target, None)
            assert near is not None
            assert far is not None
            assert (near > far) == metric.higher_is_better, metric.name


@pytest.mark.parametrize("score", metrics.VIEW_METRICS.values(), ids=metrics.VIEW_METRICS)
def test_wrong_shapes_are_refused(
    score: Callable[[Tensor, Tensor, Tensor | None], float | None],
) -> None:
    for shapes in ((9, 9, 3), (9, 8, 3)), ((9, 9), (9, 9)), ((3, 9, 9), (3, 9, 9)):
        image, target = map(torch.zeros, shapes)
        with pytest.raises(ValueError, match=r"must be the same \[H, W, 3\]"):
            score(image, target, torch.ones(target.shape[:2], dtype=torch.bool))
    image, target = pair()
    if score is not metrics.psnr_plain:
        with pytest.raises(ValueError, match=r"mask \[40, 40\] must be \[40, 53\]"):
            score(image, target, torch.ones(40, 40, dtype=torch.bool))
    with pytest.raises(ValueError, match="20 x 5 px is too small for SSIM"):
        metrics.ssim(torch.zeros(5, 20, 3), torch.zeros(5, 20, 3))
    assert metrics.ssim(torch.zeros(6, 20, 3), torch.zeros(6, 20, 3)) == pytest.approx(1, abs=1e-4)


def half_mask() -> Tensor:
    """The left half of `pair` and a single pixel on the right are used."""
    mask = torch.zeros(40, 53, dtype=torch.bool)
    mask[:, :26] = True
    mask[3, 40] = True
    return mask


@settings(max_examples=20)
@given(st.integers(0, 2**32 - 1))
def test_what_is_hidden_by_a_mask_changes_no_score(seed: int) -> None:
    (image, target), mask = pair(), half_mask()
    hidden = torch.rand(image.shape, generator=torch.Generator().manual_seed(seed))
    painted, photograph = (of.where(mask[..., None], hidden * of) for of in (image, target))
    for score in (metrics.psnr, metrics.ssim):
        assert score(painted, photograph, mask) == score(image, target, mask)
    assert metrics.psnr(painted, photograph) != metrics.psnr(image, target)


def test_psnr_inside_a_mask_is_of_its_pixels() -> None:
    (image, target), mask = pair(), half_mask()
    error = (image.double() - target.double())[mask].square().mean().item()
    assert metrics.psnr(image, target, mask) == pytest.approx(-10 * math.log10(error), rel=1e-12)
    assert metrics.psnr_plain(image, target, mask) == metrics.psnr(image, target)
    assert metrics.psnr_plain(image, target, None) is None


@pytest.mark.parametrize("mask", [None, half_mask()])
def test_psnr_after_a_fit_is_that_of_least_squares(mask: Tensor | None) -> None:
    image, target = pair()
    used = slice(None) if mask is None else mask.flatten().numpy()
    rows = image.double().reshape(-1, 3).numpy()[used]
    rows = np.concatenate([rows, np.ones((len(rows), 1))], axis=1)
    wanted = target.double().reshape(-1, 3).numpy()[used]
    found = (rows @ np.linalg.lstsq(rows, wanted, rcond=None)[0]).clip(0, 1)
    expected = -10 * math.log10(((found - wanted) ** 2).mean())
    assert metrics.psnr_fitted(image, target, mask) == pytest.approx(expected, rel=1e-9)
    plain = metrics.psnr(image, target, mask)
    assert plain is not None
    assert expected > plain + 0.1


def test_a_colour_map_of_the_photograph_costs_nothing_after_a_fit() -> None:
    _, target = pair()
    colors = torch.tensor([[0.6, 0.1, 0.0], [0.0, 0.8, 0.1], [0.1, 0.0, 0.7]])
    fitted = metrics.psnr_fitted(target @ colors + 0.1, target)
    assert fitted is not None
    assert fitted > 120
    flat = metrics.psnr_fitted(torch.full_like(target, 0.5), target)  # no unique map
    centred = target - target.mean(dim=(0, 1))
    assert flat == pytest.approx(-10 * math.log10(centred.square().mean()), abs=1e-4)


def test_ssim_inside_a_mask_is_the_mean_of_the_definition_there() -> None:
    (image, target), mask = pair(), half_mask()
    filled = torch.from_numpy(masks.filled(target.numpy(), mask.numpy()))
    values = ssim_map_by_definition(image.where(mask[..., None], filled), filled)
    expected = values[mask.numpy()].mean()
    assert metrics.ssim(image, target, mask) == pytest.approx(expected, abs=1e-6)
    assert abs(expected - values.mean()) > 0.1


def test_a_mask_of_all_pixels_changes_no_bit_and_one_of_none_has_no_score() -> None:
    image, target = pair()
    every = torch.ones(40, 53, dtype=torch.bool)
    for score in (metrics.psnr, metrics.ssim):
        assert score(image, target, every) == score(image, target)
        assert score(image, target, ~every) is None


def test_views_that_are_scored_together_have_the_same_scores() -> None:
    image, target = pair()
    plain = metrics.score_view(image, target, None, masked=False)
    assert plain == {
        "lpips": None,
        "ssim": metrics.ssim(image, target),
        "psnr": metrics.psnr(image, target),
        "psnr_plain": None,
        "psnr_fitted": metrics.psnr_fitted(image, target),
    }
    assert metrics.score_view(image, target, None, masked=True) == plain | {
        "psnr_plain": plain["psnr"]
    }
