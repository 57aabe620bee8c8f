"""Rendering over the whole range of float32's exponents, against the float64 reference."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st
from torch import Tensor

from tests.splat.scenes import Scene, draw, gradients_of, make_camera, make_scene, with_gradients
from xrgs.splat.cameras import Camera
from xrgs.splat.quaternions import rotation_matrices
from xrgs.splat.settings import RasterSettings

#: The exponents of the smallest denormal and of the largest number of float32.
LEAST, MOST = -149, 127
FEW = settings(
    max_examples=20,
    deadline=None,
    phases=[Phase.explicit, Phase.generate],
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
CAMERA = make_camera()
CAMERA = Camera(CAMERA.viewmat.float().double(), CAMERA.K.float().double(), 20, 14)


def rendered(scene: Scene, backend: str, raster: RasterSettings) -> tuple[Tensor, Scene]:
    """The image, and the gradients of a loss that weighs every pixel differently."""
    leaves = with_gradients(scene)
    image = draw(leaves, CAMERA, raster, backend=backend).image
    weights = torch.linspace(-1, 1, image.numel(), dtype=image.dtype).reshape(image.shape)
    torch.autograd.backward((image * weights).sum())
    return image.detach(), gradients_of(leaves)


def check(scene: Scene, backend: str, raster: RasterSettings) -> None:
    image, gradients = rendered(scene, backend, raster)
    double = {name: value.double() for name, value in scene.items()}
    true_image, true_gradients = rendered(double, "torch", raster)
    assert (image - true_image).abs().max() < 3e-5
    for name, gradient in gradients.items():
        largest = true_gradients[name].reshape(20, -1).abs().amax(1)  # of each Gaussian
        error = (gradient.double() - true_gradients[name]).reshape(20, -1).abs().amax(1)
        # What is below float32's normal numbers may be 0.
        assert (error <= 2e-3 * largest.max().clamp_min(1e-30) + 1e-37).all(), name


def exact(values: Tensor, exponent: int) -> Tensor:
    """Values times 2^exponent in float32, denormal numbers among them."""
    return torch.ldexp(values.double(), torch.tensor(exponent)).float()


@FEW
@given(exponents=st.lists(st.integers(LEAST, MOST - 2), min_size=5, max_size=5))
def test_the_length_of_a_quaternion_changes_no_image(backend: str, exponents: list[int]) -> None:
    scene = make_scene(20, CAMERA, seed=1, dtype=torch.float32)
    for row, exponent in enumerate(exponents):
        scene["quats"][row] = exact(scene["quats"][row], exponent)
    double = {name: value.double() for name, value in scene.items()}
    image = draw(scene, CAMERA, backend=backend).image
    assert (image - draw(double, CAMERA).image).abs().max() < 3e-5


@FEW
@given(exponents=st.lists(st.integers(-120, 100), min_size=5, max_size=5))
def test_gradients_of_quaternions_of_any_length(backend: str, exponents: list[int]) -> None:
    scene = make_scene(20, CAMERA, seed=1, dtype=torch.float32)
    unit = {name: value.double() for name, value in scene.items()}
    for row, exponent in enumerate(exponents):
        scene["quats"][row] = exact(scene["quats"][row], exponent)
    _, gradients = rendered(scene, backend, RasterSettings())
    _, true = rendered(unit, "torch", RasterSettings())
    for row, exponent in enumerate(exponents):
        scaled = torch.ldexp(gradients["quats"][row].double(), torch.tensor(exponent))
        error = (scaled - true["quats"][row]).abs().max()
        assert error < 2e-3 * true["quats"].abs().max(), exponent


def test_a_quaternion_of_denormal_numbers_alone_is_normalised(backend: str) -> None:
    """Its components are 3, -5, 2 and 7 times the smallest number above 0."""
    quat = torch.tensor([3.0, -5, 2, 7])
    scene = make_scene(20, CAMERA, seed=1, dtype=torch.float32)
    scene["quats"][:] = exact(quat, LEAST)
    image = draw(scene, CAMERA, backend=backend).image
    scene["quats"][:] = quat
    assert (image - draw(scene, CAMERA, backend=backend).image).abs().max() < 1e-6
    rotations = rotation_matrices(exact(quat, LEAST)[None])
    torch.testing.assert_close(rotations, rotation_matrices(quat[None]))


@FEW
@given(
    exponents=st.lists(st.integers(-60, 56), min_size=5, max_size=5),
    axis=st.sampled_from([slice(0, 3), slice(0, 2)]),
    antialiased=st.booleans(),
)
def test_gaussians_of_any_size_are_drawn(
    backend: str, exponents: list[int], axis: slice, *, antialiased: bool
) -> None:
    scene = make_scene(20, CAMERA, seed=2, dtype=torch.float32)
    for row, exponent in enumerate(exponents):
        scene["scales"][row, axis] = 0.1 * 2.0**exponent
    check(scene, backend, RasterSettings(antialiased=antialiased))


@pytest.mark.parametrize("size", [1e10, 1e14, 1e16])
def test_a_gaussian_of_many_pixels_fills_the_image(backend: str, size: float) -> None:
    scene = make_scene(1, CAMERA, seed=2, dtype=torch.float32)
    scene["scales"][:] = size
    render = draw(scene, CAMERA, backend=backend)
    assert render.visible.all()
    assert (render.alpha - scene["opacities"]).abs().max() < 1e-6


@pytest.mark.parametrize("size", [1e18, 1e25, 3e38])
@pytest.mark.parametrize("raster", [RasterSettings(), RasterSettings(antialiased=True)])
def test_a_gaussian_larger_than_float32_holds_is_refused(
    backend: str, size: float, raster: RasterSettings
) -> None:
    scene = make_scene(8, CAMERA, seed=2, dtype=torch.float32)
    scene["scales"][3, 1] = size
    with pytest.raises(
        ValueError, match=r"^scales: a Gaussian is larger than 1e\+?18 px in the im"
    ):
        draw(scene, CAMERA, raster, backend=backend)
    for hidden in ({"means": torch.tensor([0.0, 0, -5])}, {"opacities": torch.tensor(0.0)}):
        draw({k: v.index_copy(0, torch.tensor([3]), hidden[k][None]) if k in hidden else v
              for k, v in scene.items()}, CAMERA, raster, backend=backend)  # fmt: skip


@pytest.mark.parametrize("width", [0.1, 0.03, 0.01])
def test_needles_without_dilation_are_as_exact_as_their_place(backend: str, width: float) -> None:
    """A place is rounded to float32: some 2^-24 of the image's size, by the width of the needle."""
    scene = make_scene(30, CAMERA, seed=7, dtype=torch.float32, size=width)
    scene["scales"][:, 0] *= 20 / width
    image = draw(scene, CAMERA, RasterSettings(eps2d=0.0), backend=backend).image
    double = {name: value.double() for name, value in scene.items()}
    error = (image - draw(double, CAMERA, RasterSettings(eps2d=0.0)).image).abs().max()
    assert error < 32 * 20 * math.ldexp(1, -24) / width
