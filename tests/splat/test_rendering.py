"""`rasterize` and `rasterize_parameters`: what they accept, return, and name in errors."""

from __future__ import annotations

import re
from typing import Any

import pytest
import torch
from torch import Tensor

from tests.splat.scenes import make_camera, make_scene
from xrgs.splat.cameras import Camera
from xrgs.splat.gaussians import PARAMETERS, Gaussians
from xrgs.splat.rendering import Render, rasterize, rasterize_parameters, zero_means2d_offset
from xrgs.splat.settings import RasterSettings

SCENE = make_scene(6, make_camera(), dtype=torch.float32)
SCENE["means"][:2] = torch.tensor([0.0, 0.0, 3.0])  # in view: their harmonics are read


def draw(**changes: Any) -> Render:
    """Render `SCENE` with some of its parameters or some options changed."""
    options: dict[str, Any] = {
        "camera": make_camera(),
        "settings": RasterSettings(),
        "sh_degree": 3,
    }
    return rasterize_parameters(**{**SCENE, **options, **changes})


def test_image_is_not_clamped_above(backend: str) -> None:
    assert draw(backend=backend, sh0=torch.full((6, 1, 3), 50.0)).image.max() > 2


def test_an_offset_of_zeros_changes_nothing_and_needs_no_memory(backend: str) -> None:
    plain = draw(backend=backend).image
    gradients: list[Tensor] = []
    for offset in (zero_means2d_offset(6), torch.zeros(6, 2, requires_grad=True)):
        image = draw(backend=backend, means2d_offset=offset).image
        assert torch.equal(image, plain)
        gradients += torch.autograd.grad(image.square().sum(), offset)
    assert gradients[0].any()
    assert torch.equal(gradients[0], gradients[1])


# --- errors -------------------------------------------------------------------------------------


def with_value(name: str, bad: float) -> dict[str, Tensor]:
    """A parameter or the offset, one of whose values is this one."""
    value = (SCENE | {"means2d_offset": torch.zeros(6, 2)})[name].clone()
    value.view(-1)[3] = bad
    return {name: value}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        *(
            (with_value(name, bad), f"^{name} has values that are not finite")
            for name in (*PARAMETERS, "means2d_offset")
            for bad in (torch.nan, torch.inf)
        ),
        (with_value("opacities", -0.01), "^opacities has values outside"),
        (with_value("opacities", 1.01), "^opacities has values outside"),
        (with_value("scales", -1e-3), "^scales has values below"),
    ],
)
def test_a_value_out_of_range_is_named(backend: str, changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        draw(backend=backend, **changes)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"sh_degree": -1}, "sh_degree"),
        ({"sh_degree": 4}, "sh_degree"),
        ({"sh_degree": 2, "shN": torch.zeros(6, 3, 3)}, "sh_degree 2 needs shN"),
        ({"shN": torch.zeros(6, 24, 3)}, r"^shN must be .* at most 15, got \[6, 24, 3\]"),
        ({"means": SCENE["means"].double()}, "must be of the floating type of means"),
        ({"shN": SCENE["shN"].long()}, "^shN must be of the floating type of means"),
        *(
            (
                {name: torch.zeros(shape)},
                rf"^{name} must be \[.*, got {re.escape(str(list(shape)))}",
            )
            for name, shape in (
                ("means", (6, 2)),
                ("means", ()),
                ("quats", (5, 4)),
                ("scales", (6,)),
                ("opacities", (6, 1)),
                ("sh0", (6, 3)),
                ("shN", (6, 15)),
                ("shN", (6, 15, 4)),
                ("means2d_offset", (6, 3)),
            )
        ),
    ],
)
def test_a_wrong_shape_type_or_degree_is_named(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        draw(**changes)


def test_the_native_backend_is_for_float32() -> None:
    pytest.importorskip("xrgs._native")
    with pytest.raises(ValueError, match="float32"):
        draw(backend="native", **{name: value.double() for name, value in SCENE.items()})


# --- rasterize ----------------------------------------------------------------------------------


@pytest.fixture
def gaussians() -> Gaussians:
    generator = torch.Generator().manual_seed(0)
    points = torch.rand(40, 3, generator=generator) - 0.5
    made = Gaussians.from_points(points, torch.rand(40, 3, generator=generator), sh_degree=2)
    with torch.no_grad():
        made.shN += 0.2 * torch.randn(made.shN.shape, generator=generator)
    return made


@pytest.fixture
def camera() -> Camera:
    return Camera.look_at((0.5, -2.0, 0.4), (0.0, 0.0, 0.0), width=40, height=30)


def test_the_image_is_that_of_the_activated_parameters(
    gaussians: Gaussians, camera: Camera, backend: str
) -> None:
    settings = RasterSettings(background=(0.1, 0.2, 0.3))
    render = rasterize(gaussians, camera, settings=settings, backend=backend)
    expected = rasterize_parameters(
        *gaussians.activated(backend=backend), camera, settings, sh_degree=2, backend=backend
    )
    assert torch.equal(render.image, expected.image)
    assert torch.equal(render.alpha, expected.alpha)
    assert 0.05 < render.alpha.mean() < 1
    torch.autograd.backward(render.image.square().sum())
    for name in PARAMETERS:
        gradient = gaussians[name].grad
        assert gradient is not None
        assert gradient.abs().max() > 0, name


def test_bands_can_be_left_out(gaussians: Gaussians, camera: Camera) -> None:
    plain = rasterize(gaussians, camera, sh_degree=0).image
    assert not torch.equal(plain, rasterize(gaussians, camera).image)
    with torch.no_grad():
        gaussians.shN.zero_()
    for settings in (None, RasterSettings(sh_degree=0)):
        assert torch.equal(plain, rasterize(gaussians, camera, settings=settings).image)
    with pytest.raises(ValueError, match="sh_degree 3 needs shN"):
        rasterize(gaussians, camera, sh_degree=3)


def test_double_precision_is_rendered_by_torch(gaussians: Gaussians, camera: Camera) -> None:
    wide = Gaussians(**{name: gaussians[name].detach().double() for name in PARAMETERS})
    render = rasterize(wide, camera)
    assert render.image.dtype == torch.float64
    torch.testing.assert_close(
        render.image.float(), rasterize(gaussians, camera).image, rtol=0, atol=2e-5
    )


@pytest.mark.parametrize(("name", "bad"), [("sh0", torch.nan), ("shN", torch.inf)])
def test_harmonics_of_gaussians_that_are_not_drawn_are_checked(
    backend: str, name: str, bad: float
) -> None:
    camera = make_camera()
    scene = make_scene(20, camera, dtype=torch.float32)
    scene["means"][17] = torch.tensor([0.0, 0.0, -5.0])  # behind the camera
    scene[name][17, 0, 1] = bad
    with pytest.raises(ValueError, match=f"^{name} has values that are not finite"):
        rasterize(Gaussians(**scene), camera, backend=backend)


def test_another_device_is_refused(gaussians: Gaussians, camera: Camera) -> None:
    moved = Gaussians(**{name: gaussians[name].to("meta") for name in PARAMETERS})
    with pytest.raises(ValueError, match="means is on meta: xrgs renders on the CPU"):
        rasterize(moved, camera)
