"""The renderer's image against a splatter written per pixel in numpy."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from scipy.special import sph_harm_y

from tests.splat.scenes import Scene, draw, make_camera, make_scene
from xrgs.splat.cameras import Camera
from xrgs.splat.settings import RasterSettings

Array = NDArray[np.float64]
#: Depth, index, mean, inverse covariance, opacity and colour.
Splat = tuple[float, int, Array, Array, float, Array]

NO_CUTS = RasterSettings(alpha_min=0.0, alpha_max=1.0, transmittance_min=0.0)


def naive_color(direction: Array, coeffs: Array) -> Array:
    """Real spherical harmonics from scipy's complex ones."""
    x, y, z = direction / np.linalg.norm(direction)
    color: Array = np.full(3, 0.5)
    for index in range(len(coeffs)):
        degree = int(index**0.5)
        order = index - degree * degree - degree
        value = sph_harm_y(degree, abs(order), np.arccos(z), np.arctan2(y, x))
        real = value.real if order >= 0 else value.imag
        color += (real if order == 0 else np.sqrt(2) * real) * coeffs[index]
    clamped: Array = np.maximum(color, 0)
    return clamped


def naive_rotation(quat: Array) -> Array:
    if not quat.any():
        return np.eye(3)
    w, x, y, z = quat / np.linalg.norm(quat)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    rotation: Array = np.eye(3) + 2 * w * cross + 2 * cross @ cross
    return rotation


def naive_splats(scene: Scene, camera: Camera, raster: RasterSettings) -> list[Splat]:
    """Depth, index, mean, inverse covariance, opacity and colour of all in front of the camera."""
    viewmat, K = camera.viewmat.numpy(), camera.K.numpy()
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    splats = []
    for i in range(len(scene["means"])):
        mean, quat, scale = (scene[n][i].detach().numpy() for n in ("means", "quats", "scales"))
        x, y, z = viewmat[:3, :3] @ mean + viewmat[:3, 3]
        if z <= raster.near:
            continue
        margin_x, margin_y = 0.15 * camera.width / fx, 0.15 * camera.height / fy
        tx = z * np.clip(x / z, -cx / fx - margin_x, (camera.width - cx) / fx + margin_x)
        ty = z * np.clip(y / z, -cy / fy - margin_y, (camera.height - cy) / fy + margin_y)
        J = np.array([[fx / z, 0, -fx * tx / z**2], [0, fy / z, -fy * ty / z**2]])
        half = J @ viewmat[:3, :3] @ naive_rotation(quat) @ np.diag(scale)
        cov = half @ half.T
        dilated = cov + raster.eps2d * np.eye(2)
        opacity = float(scene["opacities"][i])
        if raster.antialiased:
            opacity *= np.sqrt(max(0, np.linalg.det(cov) / np.linalg.det(dilated)))
        coeffs = torch.cat([scene["sh0"][i], scene["shN"][i]]).detach().numpy()
        color = naive_color(mean - camera.position.numpy(), coeffs)
        place = np.array([fx * x / z + cx, fy * y / z + cy])
        splats.append((z, i, place, np.linalg.inv(dilated), opacity, color))
    return sorted(splats, key=lambda splat: splat[:2])


def naive(scene: Scene, camera: Camera, raster: RasterSettings) -> tuple[Array, Array]:
    image = np.zeros((camera.height, camera.width, 3))
    alphas = np.zeros((camera.height, camera.width))
    splats = naive_splats(scene, camera, raster)
    for row in range(camera.height):
        for column in range(camera.width):
            transmittance = 1.0
            for _, _, place, conic, opacity, color in splats:
                d = np.array([column + 0.5, row + 0.5]) - place
                alpha = min(raster.alpha_max, float(opacity * np.exp(-0.5 * d @ conic @ d)))
                if alpha < raster.alpha_min:
                    continue
                if transmittance * (1 - alpha) <= raster.transmittance_min:
                    break
                image[row, column] += transmittance * alpha * color
                transmittance *= 1 - alpha
            image[row, column] += transmittance * np.array(raster.background)
            alphas[row, column] = 1 - transmittance
    return image, alphas


@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize(
    "raster",
    [
        RasterSettings(),
        RasterSettings(background=(0.2, 0.5, 0.9)),
        RasterSettings(antialiased=True, eps2d=0.1),
        RasterSettings(alpha_min=0.1, alpha_max=0.5, transmittance_min=0.2),
        NO_CUTS,
    ],
    ids=["default", "background", "antialiased", "hard cuts", "no cuts"],
)
def test_image_is_the_naive_splatters(raster: RasterSettings, seed: int) -> None:
    camera = make_camera(turned=bool(seed))
    scene = make_scene(40, camera, seed=seed, size=2.5)
    scene["opacities"][::3] = 1.0
    scene["scales"][::5, 0] *= 10
    scene["quats"][0] = 0
    render = draw(scene, camera, raster)
    image, alpha = naive(scene, camera, raster)
    np.testing.assert_allclose(render.image, image, atol=1e-10)
    np.testing.assert_allclose(render.alpha, alpha, atol=1e-10)
    assert np.std(image) > 0.05


@pytest.mark.parametrize(("width", "height"), [(1, 1), (1, 9), (17, 1), (8, 8), (9, 7), (16, 24)])
def test_sizes_that_are_no_multiple_of_a_tile(width: int, height: int) -> None:
    camera = make_camera(width, height)
    scene = make_scene(12, camera, seed=width, size=3.0)
    render = draw(scene, camera)
    assert render.image.shape == (height, width, 3)
    np.testing.assert_allclose(render.image, naive(scene, camera, RasterSettings())[0], atol=1e-10)
