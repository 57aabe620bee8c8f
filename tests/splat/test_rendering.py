"""The public `rasterize`: Gaussians and a camera in, the same image as by hand out."""

from __future__ import annotations

import pytest
import torch

from xrgs.splat.cameras import Camera
from xrgs.splat.gaussians import PARAMETERS, Gaussians
from xrgs.splat.rendering import rasterize, rasterize_parameters
from xrgs.splat.settings import RasterSettings


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


@pytest.mark.parametrize("backend", ["native", "torch"])
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


def test_every_parameter_has_a_gradient(gaussians: Gaussians, camera: Camera) -> None:
    torch.autograd.backward(rasterize(gaussians, camera).image.square().sum())
    for name in PARAMETERS:
        gradient = gaussians[name].grad
        assert gradient is not None
        assert gradient.abs().max() > 0, name


def test_bands_can_be_left_out(gaussians: Gaussians, camera: Camera) -> None:
    plain = rasterize(gaussians, camera, sh_degree=0).image
    assert not torch.equal(plain, rasterize(gaussians, camera).image)
    with torch.no_grad():
        gaussians.shN.zero_()
    assert torch.equal(plain, rasterize(gaussians, camera).image)
    assert torch.equal(
        plain, rasterize(gaussians, camera, settings=RasterSettings(sh_degree=0)).image
    )
    with pytest.raises(ValueError, match="sh_degree 3 needs shN"):
        rasterize(gaussians, camera, sh_degree=3)


def test_double_precision_is_rendered_by_torch(gaussians: Gaussians, camera: Camera) -> None:
    wide = Gaussians(**{name: gaussians[name].detach().double() for name in PARAMETERS})
    render = rasterize(wide, camera)
    assert render.image.dtype == torch.float64
    torch.testing.assert_close(
        render.image.float(), rasterize(gaussians, camera).image, rtol=0, atol=2e-5
    )


def test_another_device_is_refused(gaussians: Gaussians, camera: Camera) -> None:
    moved = Gaussians(**{name: gaussians[name].to("meta") for name in PARAMETERS})
    with pytest.raises(ValueError, match="means is on meta: xrgs renders on the CPU"):
        rasterize(moved, camera)
