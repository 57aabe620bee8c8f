from __future__ import annotations

import numpy as np
import pytest
import torch
from gsplat.cuda._torch_impl import _spherical_harmonics
from scipy.special import sph_harm_y
from torch import Tensor

from xrgs.splat.sh import sh_basis, sh_to_colors


@pytest.fixture
def dirs() -> torch.Tensor:
    generator = torch.Generator().manual_seed(0)
    random = torch.randn(40, 3, generator=generator, dtype=torch.float64)
    axes = torch.eye(3, dtype=torch.float64)
    return torch.nn.functional.normalize(torch.cat([random, axes, -axes]), dim=-1)


def test_basis_is_scipys_real_spherical_harmonics(dirs: Tensor) -> None:
    x, y, z = dirs.numpy().T
    polar, azimuth = np.arccos(z), np.arctan2(y, x)
    ours = sh_basis(3, dirs).numpy()
    for degree in range(4):
        for order in range(-degree, degree + 1):
            harmonic = sph_harm_y(degree, abs(order), polar, azimuth)
            real = np.sqrt(2) * (harmonic.real if order > 0 else harmonic.imag)
            expected = harmonic.real if order == 0 else real
            np.testing.assert_allclose(
                ours[:, degree * degree + degree + order], expected, atol=1e-12
            )


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_colors_are_gsplats(dirs: Tensor, degree: int) -> None:
    generator = torch.Generator().manual_seed(1)
    coeffs = torch.randn(len(dirs), 16, 3, generator=generator, dtype=torch.float64)
    expected = (_spherical_harmonics(degree, dirs, coeffs) + 0.5).clamp_min(0)
    ours = sh_to_colors(degree, dirs, coeffs[:, :1], coeffs[:, 1:])
    # gsplat's constants are written to 13 digits.
    torch.testing.assert_close(ours, expected, atol=1e-11, rtol=0)
    assert (ours == 0).any(), "the clamp must have been tried"


def test_gradient(dirs: Tensor) -> None:
    generator = torch.Generator().manual_seed(3)
    sh0 = 1 + torch.rand(5, 1, 3, generator=generator, dtype=torch.float64)
    shN = 0.1 * torch.randn(5, 15, 3, generator=generator, dtype=torch.float64)
    inputs = [value.requires_grad_() for value in (dirs[:5].clone(), sh0, shN)]
    assert torch.autograd.gradcheck(lambda *args: sh_to_colors(3, *args), inputs)
