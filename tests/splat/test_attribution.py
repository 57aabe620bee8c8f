"""A map of pixels, attributed to the Gaussians: against a loop over the pixels, and native."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from torch import Tensor

from tests.splat.scenes import Scene, draw, make_camera, make_scene, with_gradients
from xrgs.splat.cameras import Camera
from xrgs.splat.gaussians import ActivatedGaussians
from xrgs.splat.rendering import attribute_pixels
from xrgs.splat.settings import RasterSettings


@pytest.fixture
def in_a_row() -> Scene:
    """Three isotropic Gaussians behind one another, near the optical axis; the last is first."""
    return {
        "means": torch.tensor([[0.1, 0.0, 4.0], [-0.1, 0.1, 3.0], [0.0, 0.0, 2.0]]).double(),
        "quats": torch.tensor([[1.0, 0, 0, 0]]).repeat(3, 1).double(),
        "scales": torch.tensor([0.5, 0.3, 0.1])[:, None].repeat(1, 3).double(),
        "opacities": torch.tensor([0.9, 0.6, 0.3]).double(),
        "sh0": torch.full((3, 1, 3), -9.0).double(),  # black: their colours are clamped
        "shN": torch.zeros(3, 0, 3).double(),
    }


def random_map(camera: Camera) -> Tensor:
    generator = torch.Generator().manual_seed(3)
    return torch.rand(camera.height, camera.width, generator=generator, dtype=torch.float64)


def blending_weights(scene: Scene, camera: Camera, x: float, y: float) -> list[float]:
    """The weights of isotropic Gaussians in one pixel, one after the other, nearest first."""
    fx, fy, cx, cy = (float(camera.K[i, j]) for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))
    weights, transmittance = [0.0] * len(scene["means"]), 1.0
    for i in sorted(range(len(weights)), key=lambda i: float(scene["means"][i, 2])):
        mx, my, mz = scene["means"][i].tolist()
        variance = float(scene["scales"][i, 0]) ** 2
        jacobian = np.array([[fx / mz, 0, -fx * mx / mz**2], [0, fy / mz, -fy * my / mz**2]])
        covariance = variance * jacobian @ jacobian.T + 0.3 * np.eye(2)
        d = np.array([x - (fx * mx / mz + cx), y - (fy * my / mz + cy)])
        power = -0.5 * d @ np.linalg.inv(covariance) @ d
        alpha = min(0.99, float(scene["opacities"][i]) * math.exp(power))
        if alpha >= 1 / 255:
            weights[i] = transmittance * alpha
            transmittance *= 1 - alpha
    return weights


def test_it_is_the_sum_over_pixels_of_map_times_blending_weight(in_a_row: Scene) -> None:
    camera = make_camera()
    pixels = random_map(camera)
    expected = torch.zeros(3, dtype=torch.float64)
    for row in range(camera.height):
        for column in range(camera.width):
            weights = blending_weights(in_a_row, camera, column + 0.5, row + 0.5)
            expected += pixels[row, column] * torch.tensor(weights, dtype=torch.float64)
    gaussians = ActivatedGaussians(**in_a_row)
    sums = attribute_pixels(pixels, gaussians, camera, RasterSettings()).sums
    torch.testing.assert_close(sums, expected, rtol=1e-10, atol=1e-10)
    assert (expected > 0.2).all()


def test_a_map_of_ones_comes_to_the_alpha_of_the_image() -> None:
    camera = make_camera(turned=True)
    scene = make_scene(40, camera)
    render = draw(scene, camera)
    ones = torch.ones(camera.height, camera.width, dtype=torch.float64)
    leaves = with_gradients(scene)
    found = attribute_pixels(ones, ActivatedGaussians(**leaves), camera, RasterSettings())
    torch.testing.assert_close(found.sums.sum(), render.alpha.sum())
    assert found.evaluations == render.evaluations
    assert (found.sums[~render.visible] == 0).all()
    # Nothing of the Gaussians is changed.
    assert not found.sums.requires_grad
    assert all(leaf.grad is None for leaf in leaves.values())


def test_native_attributes_as_torch_does() -> None:
    pytest.importorskip("xrgs._native")
    camera = make_camera(40, 30, turned=True)
    scene = make_scene(200, camera, dtype=torch.float32)
    gaussians, pixels = ActivatedGaussians(**scene), random_map(camera).float()
    settings = RasterSettings(antialiased=True)
    native = attribute_pixels(pixels, gaussians, camera, settings, backend="native").sums
    expected = attribute_pixels(pixels, gaussians, camera, settings).sums
    torch.testing.assert_close(native, expected, rtol=1e-3, atol=1e-3)
    assert expected.std() > 0.1
