"""The window of the SSIM against scipy's Gaussian filter."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter

from xrgs.splat.ssim import SIGMA, WINDOW, window_mean, window_moments


@pytest.mark.parametrize("size", [(11, 11), (11, 30), (25, 17)])
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


def test_a_flat_image_has_no_variance_below_zero() -> None:
    # E[x^2] - E[x]^2 in float32 is below 0 for about half of these levels.
    for level in torch.linspace(0.1, 300, 40):
        _, variance = window_moments(torch.full((12, 12, 3), level.item()))
        assert (variance >= 0).all()
