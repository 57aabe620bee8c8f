"""The SSIM of the training loss against kornia and scipy's Gaussian filter.

test_loss.py compares it with scikit-image's.
"""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import gaussian_filter
from torch import Tensor

from tests.splat.scenes import noise, similar_pair
from xrgs.splat.loss import photometric_loss, prepare_target
from xrgs.splat.ssim import SIGMA, WINDOW, Target, window_mean, window_moments


@pytest.mark.parametrize("size", [(11, 30), (25, 17)])
def test_the_mean_is_that_of_scipys_filter(size: tuple[int, int]) -> None:
    image = np.random.default_rng(0).random((*size, 3))
    border = WINDOW // 2
    filtered = gaussian_filter(image, SIGMA, radius=border, axes=(0, 1))
    expected = filtered[border : size[0] - border, border : size[1] - border]
    np.testing.assert_allclose(window_mean(torch.from_numpy(image)), expected, rtol=1e-12)


def test_moments_are_those_of_a_distribution() -> None:
    image = np.random.default_rng(1).random((11, 11, 2))
    taps = np.exp(-((np.arange(WINDOW) - 5) ** 2) / (2 * SIGMA**2))
    weights = np.outer(taps, taps).reshape(-1) / taps.sum() ** 2
    samples = image.reshape(-1, 2)
    mean = weights @ samples
    mean_of_window, variance = window_moments(torch.from_numpy(image))
    np.testing.assert_allclose(mean_of_window[0, 0], mean, rtol=1e-12)
    np.testing.assert_allclose(variance[0, 0], weights @ (samples - mean) ** 2, rtol=1e-10)


@pytest.mark.parametrize("height", [42, 43, 100])
def test_a_target_has_the_moments_of_the_whole_image(height: int) -> None:
    """It computes them in blocks of rows, and in double."""
    image = noise(height, 15, seed=height).float()
    target = prepare_target(image)
    mean, variance = window_moments(image.double())
    assert torch.equal(target.mean, mean.float())
    assert torch.equal(target.variance, variance.float())


def structural_similarity(image: Tensor, target: Target) -> Tensor:
    """The mean SSIM over pixels and channels."""
    return 1 - photometric_loss(image, target, l1=0.0, ssim=1.0, backend="torch")


@pytest.mark.parametrize("size", [(11, 11), (40, 13), (52, 67)])
def test_ssim_is_kornias(size: tuple[int, int]) -> None:
    from kornia.losses import ssim_loss
    from kornia.metrics import ssim

    image, target = similar_pair(*size)
    batch, reference = (x.permute(2, 0, 1)[None] for x in (image, target))
    # eps: kornia adds it to the denominator.
    expected = ssim(batch, reference, 11, eps=0.0, padding="valid").mean()
    value = structural_similarity(image, prepare_target(target))
    torch.testing.assert_close(value, expected, rtol=1e-12, atol=0)
    half = ssim_loss(batch, reference, 11, eps=0.0, padding="valid")
    torch.testing.assert_close(1 - value, 2 * half, rtol=1e-12, atol=0)


@settings(max_examples=25)
@given(
    size=st.tuples(st.integers(11, 24), st.integers(11, 24)),
    seeds=st.tuples(st.integers(0, 10**6), st.integers(0, 10**6)),
)
def test_ssim_is_symmetric_and_bounded(size: tuple[int, int], seeds: tuple[int, int]) -> None:
    a, b = noise(*size, seeds[0]), noise(*size, seeds[1])
    ab = structural_similarity(a, prepare_target(b)).item()
    assert ab == pytest.approx(structural_similarity(b, prepare_target(a)).item(), abs=1e-12)
    assert abs(ab) <= 1 + 1e-12
    assert structural_similarity(a, prepare_target(a)).item() == pytest.approx(1, abs=1e-12)


def test_a_variance_below_zero_counts_as_zero() -> None:
    # At these levels E[x^2] - E[x]^2 in float32 is as often below -C2 as above C2.
    target = prepare_target(torch.ones(12, 15, 3))
    for level in torch.linspace(200, 400, 100):
        image = torch.full((12, 15, 3), level.item())
        luminance = (2 * level + 1e-4) / (level**2 + 1 + 1e-4)
        value = structural_similarity(image, target)
        assert 0 <= value <= 1.2 * luminance
