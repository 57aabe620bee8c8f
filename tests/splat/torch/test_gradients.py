"""The renderer's gradients against finite differences."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from tests.splat.scenes import Scene, draw, gradients_of, make_camera, make_scene, with_gradients
from xrgs.splat.cameras import Camera
from xrgs.splat.gaussians import PARAMETERS, ActivatedGaussians
from xrgs.splat.rendering import rasterize_parameters
from xrgs.splat.settings import RasterSettings


@pytest.mark.slow
@pytest.mark.parametrize("antialiased", [False, True])
def test_gradients_are_finite_differences_with_the_cuts_off(antialiased: bool) -> None:
    camera = make_camera(6, 5, turned=True)
    raster = RasterSettings(
        alpha_min=0.0,
        alpha_max=1.0,
        transmittance_min=0.0,
        antialiased=antialiased,
        background=(0.3, 0.6, 0.1),
    )
    scene = make_scene(3, camera, seed=3, degree=1, size=2.0)
    scene["sh0"] = 2 + scene["sh0"].abs()  # away from the clamp of colours at 0
    scene["means"][0] = camera.position + 1.5 * (scene["means"][0] - camera.position)
    offset = torch.zeros(3, 2, dtype=torch.float64)
    inputs = [value.requires_grad_() for value in (*with_gradients(scene).values(), offset)]

    def outputs(*values: Tensor) -> tuple[Tensor, Tensor]:
        *parameters, offset = values
        gaussians = ActivatedGaussians(*parameters)
        render = rasterize_parameters(
            *gaussians, camera, raster, sh_degree=1, means2d_offset=offset
        )
        return render.image, render.alpha

    assert torch.autograd.gradcheck(outputs, inputs)


def test_gradients_with_the_cuts_on_are_directional_differences() -> None:
    camera = make_camera()
    raster = RasterSettings(background=(0.9, 0.2, 0.5))
    scene = make_scene(60, camera, seed=7, size=3.0)
    scene["opacities"][::2] = 0.99 + 0.005 * scene["opacities"][::2]
    weights = torch.randn(14, 20, 3, dtype=torch.float64)

    def loss(values: Scene) -> Tensor:
        return (draw(values, camera, raster).image * weights).sum()

    leaves = with_gradients(scene)
    torch.autograd.backward(loss(leaves))
    for name in PARAMETERS:
        direction = torch.randn_like(scene[name])
        ahead, behind = (
            loss(scene | {name: scene[name] + sign * 1e-7 * direction}) for sign in (1, -1)
        )
        difference = (ahead - behind) / 2e-7
        exact = (gradients_of(leaves)[name] * direction).sum()
        torch.testing.assert_close(exact, difference, rtol=1e-5, atol=1e-6)


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


def test_absgrad_sums_the_absolute_gradients_of_single_pixels() -> None:
    camera = make_camera(11, 9)  # two tiles by two
    scene = make_scene(12, camera, seed=5, size=3.0)
    generator = torch.Generator().manual_seed(0)
    v_image = torch.randn(9, 11, 3, generator=generator, dtype=torch.float64)
    v_alpha = torch.randn(9, 11, generator=generator, dtype=torch.float64)

    def values(*, absgrad: bool) -> tuple[Scene, Tensor]:
        leaves = with_gradients(scene)
        leaves["means2d_offset"] = torch.full((12, 2), 0.3, dtype=torch.float64).requires_grad_()
        raster = RasterSettings(absgrad=absgrad)
        render = draw(leaves, camera, raster, means2d_offset=leaves["means2d_offset"])
        return leaves, (render.image * v_image).sum(-1) + render.alpha * v_alpha  # [H, W]

    leaves, plain = values(absgrad=False)
    expected = torch.zeros(12, 2, dtype=torch.float64)
    for pixel in plain.flatten():
        (gradient,) = torch.autograd.grad(pixel, leaves["means2d_offset"], retain_graph=True)
        expected += gradient.abs()
    torch.autograd.backward(plain.sum())
    absolute, total = values(absgrad=True)
    torch.testing.assert_close(total, plain)
    torch.autograd.backward(total.sum())
    gradients, absolute_gradients = gradients_of(leaves), gradients_of(absolute)
    torch.testing.assert_close(absolute_gradients["means2d_offset"], expected)
    assert (expected.sum() > 1.5 * gradients["means2d_offset"].abs().sum()).all()
    for name in PARAMETERS:
        torch.testing.assert_close(absolute_gradients[name], gradients[name])
