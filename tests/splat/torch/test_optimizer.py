"""The gradient of harmonics that the optimizer derives, against autograd through the rasterizer."""

from __future__ import annotations

import pytest
import torch

from tests.splat.scenes import make_camera, make_scene
from xrgs.splat.gaussians import PARAMETERS, ActivatedGaussians, Gaussians
from xrgs.splat.optimizer import SplatOptimizer
from xrgs.splat.rendering import rasterize_parameters
from xrgs.splat.settings import OptimizerSettings, RasterSettings


@pytest.mark.parametrize("sh_degree", [0, 1, 2, 3])
def test_the_gradient_of_harmonics_follows_from_that_of_sh0(sh_degree: int) -> None:
    camera = make_camera(turned=True)
    scene = make_scene(30, camera)
    gaussians = Gaussians(**{name: value.requires_grad_() for name, value in scene.items()})
    activated = ActivatedGaussians(*(gaussians[name] for name in PARAMETERS))
    render = rasterize_parameters(*activated, camera, RasterSettings(), sh_degree=sh_degree)
    torch.autograd.backward(render.image.square().sum())
    expected = gaussians.shN.grad
    assert expected is not None
    assert bool(expected.any()) == (sh_degree > 0)
    optimizer = SplatOptimizer(gaussians, OptimizerSettings(), scene_scale=1.0, steps=10)
    gaussians.shN.grad = None
    optimizer.step(camera, sh_degree=sh_degree)
    assert gaussians.shN.grad is not None
    torch.testing.assert_close(gaussians.shN.grad, expected, rtol=1e-12, atol=1e-14)


def test_without_a_gradient_of_sh0_harmonics_stay() -> None:
    camera = make_camera()
    scene = make_scene(5, camera)
    gaussians = Gaussians(**{name: value.requires_grad_() for name, value in scene.items()})
    before = gaussians.shN.detach().clone()
    gaussians.means.grad = torch.ones_like(gaussians.means)
    optimizer = SplatOptimizer(gaussians, OptimizerSettings(), scene_scale=1.0, steps=10)
    optimizer.step(camera, sh_degree=3)
    assert gaussians.shN.grad is None
    assert torch.equal(gaussians.shN, before)
