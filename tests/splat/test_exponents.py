"""Rendering over the whole range of float32's exponents, against the float64 reference."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import HealthCheck, Phase, example, given, settings
from hypothesis import strategies as st
from torch import Tensor

from tests.splat.native.oracle import run
from tests.splat.scenes import Scene, draw, make_camera, make_scene
from xrgs.splat.cameras import Camera
from xrgs.splat.gaussians import PARAMETERS
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
    weights = torch.linspace(-1, 1, 14 * 20 * 3).reshape(14, 20, 3), torch.zeros(14, 20)
    render, gradients = run(scene, CAMERA, raster, backend, scene["means"].dtype, weights)
    return render.image.detach(), {name: gradients[name] for name in PARAMETERS}


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
@example(exponents=[LEAST, LEAST + 1, LEAST + 2, LEAST + 3, -126])
def test_the_length_of_a_quaternion_changes_no_image(backend: str, exponents: list[int]) -> None:
    scene = make_scene(20, CAMERA, seed=1, dtype=torch.float32)
    for row, exponent in enumerate(exponents):
        scene["quats"][row] = exact(scene["quats"][row], exponent)
    scene["quats"][5] = 0  # no rotation
    double = {name: value.double() for name, value in scene.items()}
    image = draw(scene, CAMERA, backend=backend).image
    assert (image - draw(double, CAMERA).image).abs().max() < 3e-5


@pytest.mark.slow
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


@pytest.mark.slow
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


@pytest.mark.parametrize(("size", "antialiased"), [(1e18, False), (1e25, True), (3e38, False)])
def test_a_gaussian_larger_than_float32_holds_is_refused(
    backend: str, size: float, antialiased: bool
) -> None:
    raster = RasterSettings(antialiased=antialiased)
    scene = make_scene(8, CAMERA, seed=2, dtype=torch.float32)
    scene["scales"][3, 1] = size
    with pytest.raises(
        ValueError, match=r"^scales: a Gaussian is larger than 1e\+?18 px in the im"
    ):
        draw(scene, CAMERA, raster, backend=backend)
    for name, hidden in (("means", torch.tensor([0.0, 0, -5])), ("opacities", torch.tensor(0.0))):
        other = scene[name].clone()
        other[3] = hidden
        draw(scene | {name: other}, CAMERA, raster, backend=backend)


@pytest.mark.parametrize("width", [0.1, 0.01])
def test_needles_without_dilation_are_as_exact_as_their_place(backend: str, width: float) -> None:
    """A place is rounded to float32: some 2^-24 of the image's size, by the width of the needle."""
    scene = make_scene(30, CAMERA, seed=7, dtype=torch.float32, size=width)
    scene["scales"][:, 0] *= 20 / width
    image = draw(scene, CAMERA, RasterSettings(eps2d=0.0), backend=backend).image
    double = {name: value.double() for name, value in scene.items()}
    error = (image - draw(double, CAMERA, RasterSettings(eps2d=0.0)).image).abs().max()
    assert error < 32 * 20 * math.ldexp(1, -24) / width
