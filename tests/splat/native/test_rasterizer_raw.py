"""Renders of raw parameters, which the projection activates itself."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from tests.splat.scenes import make_camera, make_scene
from xrgs.splat.gaussians import PARAMETERS, Gaussians
from xrgs.splat.rendering import Render, rasterize_parameters, zero_means2d_offset
from xrgs.splat.settings import RasterSettings

pytest.importorskip("xrgs._native")

SETTINGS = [RasterSettings(), RasterSettings(antialiased=True, absgrad=True)]


def raw_scene(count: int) -> Gaussians:
    """Gaussians in view and around it, as leaves."""
    scene = make_scene(count, make_camera(), dtype=torch.float32)
    scene["scales"] = scene["scales"].log()
    scene["opacities"] = scene["opacities"].logit()
    return Gaussians(**{name: value.requires_grad_() for name, value in scene.items()})


def render(
    gaussians: Gaussians, offset: Tensor, settings: RasterSettings, degree: int, *, raw: bool
) -> Render:
    return rasterize_parameters(
        *(gaussians.raw() if raw else gaussians.activated(backend="native")),
        make_camera(),
        settings,
        sh_degree=degree,
        means2d_offset=offset,
        raw=raw,
        backend="native",
    )


def results(count: int, settings: RasterSettings, degree: int, *, raw: bool) -> list[Tensor]:
    """Image, alpha, visible Gaussians, and the gradients of the raw parameters and the offset."""
    gaussians, offset = raw_scene(count), zero_means2d_offset(count)
    made = render(gaussians, offset, settings, degree, raw=raw)
    torch.autograd.backward((made.image * made.image.detach().cos()).sum() + made.alpha.sum())
    found = [made.image.detach(), made.alpha.detach(), made.visible]
    for leaf in (*(gaussians[name] for name in PARAMETERS if name != "shN"), offset):
        assert leaf.grad is not None
        assert leaf.grad.any()
        found.append(leaf.grad)
    return found


@pytest.mark.parametrize("settings", SETTINGS)
@pytest.mark.parametrize(("count", "degree"), [(17, 0), (32, 1), (333, 2), (400, 3)])
def test_the_bits_are_those_of_activated_parameters(
    isa: str, settings: RasterSettings, count: int, degree: int
) -> None:
    raw = results(count, settings, degree, raw=True)
    activated = results(count, settings, degree, raw=False)
    assert all(torch.equal(a, b) for a, b in zip(raw, activated, strict=True))


@pytest.mark.parametrize("value", [89.0, torch.inf, torch.nan])
def test_a_scale_that_float32_does_not_hold_is_named(value: float) -> None:
    gaussians = raw_scene(20)
    gaussians.scales.data[7, 1] = value
    with pytest.raises(ValueError, match="scales has values that are not finite"):
        render(gaussians, zero_means2d_offset(20), RasterSettings(), 3, raw=True)


def test_an_opacity_that_is_not_a_number_is_named() -> None:
    gaussians = raw_scene(20)
    gaussians.opacities.data[7] = torch.nan
    with pytest.raises(ValueError, match="opacities has values that are not finite"):
        render(gaussians, zero_means2d_offset(20), RasterSettings(), 3, raw=True)
