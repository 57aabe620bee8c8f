"""The renderer's gradients against finite differences.

With the cuts on, and with absgrad, tests/csrc/test_rasterizer_equations.py compares them with the
equations of docs/rasterizer.md.
"""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from tests.splat.scenes import draw, make_camera, make_scene, with_gradients
from xrgs.splat.cameras import Camera
from xrgs.splat.gaussians import PARAMETERS
from xrgs.splat.settings import RasterSettings


@pytest.mark.slow
def test_gradients_are_finite_differences_with_the_cuts_off() -> None:
    camera = make_camera(4, 3, turned=True)
    raster = RasterSettings(
        alpha_min=0.0,
        alpha_max=1.0,
        transmittance_min=0.0,
        antialiased=True,
        background=(0.3, 0.6, 0.1),
    )
    scene = make_scene(3, camera, seed=3, degree=1, size=2.0)
    scene["sh0"] = 2 + scene["sh0"].abs()  # away from the clamp of colours at 0
    scene["means"][0] = camera.position + 1.5 * (scene["means"][0] - camera.position)
    offset = torch.zeros(3, 2, dtype=torch.float64)
    inputs = [value.requires_grad_() for value in (*with_gradients(scene).values(), offset)]

    def outputs(*values: Tensor) -> tuple[Tensor, Tensor]:
        *parameters, offset = values
        scene = dict(zip(PARAMETERS, parameters, strict=True))
        render = draw(scene, camera, raster, sh_degree=1, means2d_offset=offset)
        return render.image, render.alpha

    assert torch.autograd.gradcheck(outputs, inputs)


def test_offset_moves_the_means_and_gathers_the_image_plane_gradient() -> None:
    camera = make_camera()
    scene = make_scene(30, camera, seed=4)
    # Specks, whose shape does not depend on where the Jacobian is clamped: then an offset of the
    # means is one of the principal point.
    scene["scales"] = torch.full_like(scene["scales"], 1e-3)
    shift = torch.tensor([1.0, 2.0], dtype=torch.float64)
    K = camera.K.clone()
    K[:2, 2] += shift
    shifted = draw(scene, Camera(camera.viewmat, K, camera.width, camera.height))
    offset = shift.expand(30, 2).clone().requires_grad_()
    by_offset = draw(scene, camera, means2d_offset=offset)
    torch.testing.assert_close(by_offset.image, shifted.image, atol=1e-5, rtol=0)
    (gradient,) = torch.autograd.grad(by_offset.image.square().sum(), offset)
    assert (gradient[by_offset.visible] != 0).any()
    assert (gradient[~by_offset.visible] == 0).all()
