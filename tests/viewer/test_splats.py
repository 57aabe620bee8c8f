"""Splats for viewers against scipy's rotations, and which of them are left out."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from xrgs.splat.gaussians import Gaussians
from xrgs.viewer.live import to_splats


def random_gaussians(count: int) -> Gaussians:
    generator = torch.Generator().manual_seed(0)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator)

    return Gaussians(
        normal(count, 3),
        normal(count, 4),
        normal(count, 3),
        normal(count),
        normal(count, 1, 3),
        normal(count, 15, 3),
    )


def test_splats_are_the_gaussians_with_their_flat_colours() -> None:
    gaussians = random_gaussians(20)
    splats = to_splats(gaussians, 20)
    rotations = Rotation.from_quat(gaussians.quats.numpy(), scalar_first=True).as_matrix()
    variances = np.exp(2 * gaussians.scales.double().numpy())
    covariances = np.einsum("nij,nj,nkj->nik", rotations, variances, rotations)
    assert splats.covariances == pytest.approx(covariances, rel=1e-4, abs=1e-5)
    assert (splats.centers == gaussians.means.numpy()).all()
    colours = 0.5 + 0.28209479177387814 * gaussians.sh0[:, 0].double().numpy()
    assert splats.colors == pytest.approx(colours.clip(0, 1), abs=1e-6)
    assert splats.colors.max() <= 1
    opacities = 1 / (1 + np.exp(-gaussians.opacities.double().numpy()))
    assert splats.opacities == pytest.approx(opacities, abs=1e-6)


def test_the_most_opaque_are_kept_in_their_order() -> None:
    gaussians = random_gaussians(6)
    gaussians.opacities = torch.tensor([0.0, 2.0, -1.0, 2.0, 3.0, 2.0])
    splats = to_splats(gaussians, 3)
    assert (splats.centers == gaussians.means[[1, 3, 4]].numpy()).all()
