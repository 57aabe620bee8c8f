"""The arguments of `rasterize_parameters`: what it accepts, and what its errors name."""

from __future__ import annotations

import re
from typing import Any

import pytest
import torch

from tests.splat.scenes import make_camera, make_scene
from xrgs.splat.gaussians import Gaussians
from xrgs.splat.rendering import Render, rasterize, rasterize_parameters, zero_means2d_offset
from xrgs.splat.settings import RasterSettings

NAMES = ("means", "quats", "scales", "opacities", "sh0", "shN")


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


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_result(dtype: torch.dtype) -> None:
    render = draw(**{name: value.to(dtype) for name, value in SCENE.items()})
    assert render.image.shape == (14, 20, 3)
    assert render.alpha.shape == (14, 20)
    assert render.visible.shape == (6,)
    assert render.image.dtype == render.alpha.dtype == dtype
    assert render.visible.dtype == torch.bool
    assert render.visible.any()
    assert render.evaluations > 0


def test_image_is_not_clamped_above(backend: str) -> None:
    assert draw(backend=backend, sh0=torch.full((6, 1, 3), 50.0)).image.max() > 2


def test_an_offset_of_zero_changes_nothing(backend: str) -> None:
    assert torch.equal(
        draw(backend=backend, means2d_offset=torch.zeros(6, 2)).image, draw(backend=backend).image
    )


def test_an_offset_of_zeros_without_memory_gathers_the_same_gradient(backend: str) -> None:
    offsets = zero_means2d_offset(6), torch.zeros(6, 2, requires_grad=True)
    for offset in offsets:
        torch.autograd.backward(draw(backend=backend, means2d_offset=offset).image.square().sum())
    assert offsets[0].grad is not None
    assert offsets[1].grad is not None
    assert offsets[0].grad.any()
    assert torch.equal(offsets[0].grad, offsets[1].grad)


@pytest.mark.parametrize("name", [*NAMES, "means2d_offset"])
@pytest.mark.parametrize("bad", [float("nan"), float("inf"), float("-inf")])
def test_a_value_that_is_not_finite_is_named(backend: str, name: str, bad: float) -> None:
    value = (SCENE | {"means2d_offset": torch.zeros(6, 2)})[name].clone()
    value.view(-1)[3] = bad
    with pytest.raises(ValueError, match=rf"^{name} has values"):
        draw(backend=backend, **{name: value})


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"opacities": torch.full((6,), -0.01)}, "^opacities has values outside"),
        ({"opacities": torch.full((6,), 1.01)}, "^opacities has values outside"),
        ({"scales": torch.full((6, 3), -1e-3)}, "^scales has values below"),
        ({"scales": torch.full((6, 3), 100.0).exp()}, "^scales has values that are not finite"),
        ({"sh_degree": -1}, "sh_degree"),
        ({"sh_degree": 4}, "sh_degree"),
        ({"sh_degree": 2, "shN": torch.zeros(6, 3, 3)}, "sh_degree 2 needs shN"),
        ({"shN": torch.zeros(6, 24, 3)}, r"^shN must be .* at most 15, got \[6, 24, 3\]"),
    ],
)
def test_a_value_out_of_range_is_named(backend: str, changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        draw(backend=backend, **changes)


def test_the_native_backend_is_for_float32() -> None:
    pytest.importorskip("xrgs._native")
    with pytest.raises(ValueError, match="float32"):
        draw(backend="native", **{name: value.double() for name, value in SCENE.items()})


@pytest.mark.parametrize(
    ("name", "shape"),
    [
        ("means", (6, 2)),
        ("means", ()),
        ("quats", (5, 4)),
        ("quats", (6, 3)),
        ("scales", (6,)),
        ("opacities", (6, 1)),
        ("sh0", (6, 3)),
        ("shN", (6, 15)),
        ("shN", (5, 15, 3)),
        ("shN", (6, 15, 4)),
        ("means2d_offset", (6, 3)),
    ],
)
def test_a_wrong_shape_is_named(backend: str, name: str, shape: tuple[int, ...]) -> None:
    with pytest.raises(
        ValueError, match=rf"^{name} must be \[.*, got {re.escape(str(list(shape)))}"
    ):
        draw(backend=backend, **{name: torch.zeros(shape)})


@pytest.mark.parametrize("name", NAMES)
def test_a_wrong_type_is_named(name: str) -> None:
    with pytest.raises(ValueError, match=r"must be of the floating type of means"):
        draw(**{name: SCENE[name].double()})
    with pytest.raises(ValueError, match=r"must be of the floating type of means"):
        draw(**{name: SCENE[name].long()})


def test_bands_above_the_degree_do_not_show() -> None:
    shN = SCENE["shN"].clone()
    shN[:, 3:] = 9.0
    assert torch.equal(draw(sh_degree=1, shN=shN).image, draw(sh_degree=1).image)
    assert not torch.equal(draw(sh_degree=2, shN=shN).image, draw(sh_degree=1).image)


@pytest.mark.parametrize(
    ("name", "bound"), [("opacities", 0.0), ("opacities", 1.0), ("scales", 0.0)]
)
def test_a_value_at_its_bound_is_accepted(backend: str, name: str, bound: float) -> None:
    assert (
        draw(backend=backend, **{name: torch.full_like(SCENE[name], bound)}).image.isfinite().all()
    )


@pytest.mark.parametrize("name", ["sh0", "shN"])
@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_harmonics_of_gaussians_that_are_not_drawn_are_checked(
    backend: str, name: str, bad: float
) -> None:
    camera = make_camera()
    scene = make_scene(20, camera, dtype=torch.float32)
    scene["means"][17] = torch.tensor([0.0, 0.0, -5.0])  # behind the camera
    scene[name][17, 0, 1] = bad
    gaussians = Gaussians(**scene)
    with pytest.raises(ValueError, match=f"^{name} has values that are not finite"):
        rasterize(gaussians, camera, backend=backend)
