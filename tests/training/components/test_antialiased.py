"""Mip-Splatting's 2D filter: its closed form in both backends."""

from __future__ import annotations

import pytest
import torch

from xrgs.splat.cameras import Camera
from xrgs.splat.gaussians import Gaussians
from xrgs.splat.rendering import rasterize_parameters
from xrgs.splat.settings import RasterSettings

SIZE = 31
OPACITY = 0.8
CAMERA = Camera(
    torch.eye(4),
    torch.tensor([[20.0, 0, SIZE / 2], [0, 20.0, SIZE / 2], [0, 0, 1]]),
    SIZE,
    SIZE,
)


def one(sigma: float) -> Gaussians:
    """A white Gaussian in the middle of the middle pixel, `sigma` px large."""
    return Gaussians(
        means=torch.tensor([[0.0, 0.0, 2.0]]),
        quats=torch.tensor([[1.0, 0.0, 0.0, 0.0]]),
        scales=torch.full((1, 3), sigma * 2.0 / 20.0).log(),
        opacities=torch.logit(torch.tensor([OPACITY])),
        sh0=torch.full((1, 1, 3), 0.5 / 0.28209479177387814),
        shN=torch.zeros(1, 15, 3),
    )


@pytest.mark.parametrize(("sigma", "eps2d"), [(0.2, 0.1), (0.7, 0.3), (3.0, 0.3)])
def test_a_small_gaussian_fades_instead_of_growing_brighter(
    sigma: float, eps2d: float, backend: str
) -> None:
    peaks, sums = {}, {}
    for antialiased in (False, True):
        settings = RasterSettings(
            eps2d=eps2d, antialiased=antialiased, alpha_min=1e-6, alpha_max=0.999
        )
        activated = one(sigma).activated()
        alpha = rasterize_parameters(
            *activated, CAMERA, settings, sh_degree=0, backend=backend
        ).alpha
        peaks[antialiased] = alpha[SIZE // 2, SIZE // 2].item()
        sums[antialiased] = alpha.sum().item()
    assert peaks[False] == pytest.approx(OPACITY, rel=1e-5)
    # sqrt(det S / det (S + eps I)), and S is sigma^2 I.
    factor = sigma**2 / (sigma**2 + eps2d)
    assert peaks[True] == pytest.approx(OPACITY * factor, rel=1e-4)
    if sigma**2 + eps2d > 0.7:  # else pixels are too coarse to sum up its light
        light = 2 * torch.pi * sigma**2 * OPACITY
        assert sums[True] == pytest.approx(light, rel=1e-2)
