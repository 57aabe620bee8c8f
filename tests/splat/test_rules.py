"""The rules by which a pixel is composited and Gaussians are culled, one by one."""

from __future__ import annotations

import pytest
import torch

from tests.splat.scenes import (
    draw,
    gradients_of,
    make_camera,
    make_scene,
    single_pixel,
    with_gradients,
)
from xrgs.splat.cameras import Camera
from xrgs.splat.settings import RasterSettings

# --- compositing, on one pixel --------------------------------------------------------------------


def test_a_transmittance_of_exactly_the_least_ends_the_pixel(backend: str, pixel: Camera) -> None:
    # Three alphas of exactly 1/2: the third would leave a transmittance of exactly 1/8.
    scene = single_pixel(3, opacity=0.5)
    for least, alpha in ((0.125, 0.75), (0.1249, 0.875)):
        raster = RasterSettings(transmittance_min=least)
        assert draw(scene, pixel, raster, sh_degree=0, backend=backend).alpha.item() == alpha


@pytest.mark.parametrize(
    ("opacity", "least", "seen"),
    [
        (0.5, 0.5, True),  # exactly
        (0.5, 0.5001, False),
        (1.01 / 255, 1 / 255, True),
        (0.99 / 255, 1 / 255, False),
    ],
)
def test_an_alpha_below_the_least_is_skipped(
    backend: str, pixel: Camera, opacity: float, least: float, seen: bool
) -> None:
    scene, raster = single_pixel(1, opacity=opacity), RasterSettings(alpha_min=least)
    render = draw(scene, pixel, raster, sh_degree=0, backend=backend)
    assert render.alpha.item() == pytest.approx(opacity if seen else 0.0, abs=1e-7)
    assert render.visible.tolist() == [seen]


def test_of_equal_depths_the_lower_index_is_in_front(backend: str, pixel: Camera) -> None:
    scene = single_pixel(2, opacity=0.9)
    scene["means"][:, 2] = 2.0
    scene["sh0"] = torch.tensor([[[1.0, 0, -9]], [[-9.0, 0, 1]]])
    red, _, blue = draw(scene, pixel, sh_degree=0, backend=backend).image[0, 0]
    assert red > 5 * blue


def test_opacity_one_without_a_cap_is_opaque(pixel: Camera) -> None:
    leaves = with_gradients(single_pixel(3, opacity=1.0, dtype=torch.float64))
    raster = RasterSettings(alpha_max=1.0, transmittance_min=-1.0)
    render = draw(leaves, pixel, raster, sh_degree=0)
    torch.testing.assert_close(render.alpha.item(), 1.0)
    torch.autograd.backward(render.image.sum())
    assert all(gradient.isfinite().all() for gradient in gradients_of(leaves).values())


# --- what is not seen ---------------------------------------------------------------------------


def test_behind_or_nearer_than_near_is_not_seen_and_has_no_gradient(backend: str) -> None:
    camera = make_camera()
    scene = make_scene(8, camera, seed=1, dtype=torch.float32)
    depths = torch.tensor([-3.0, -1e-3, 0.0, 1e-30, 0.009, 0.01])
    scene["means"][:6] = depths[:, None] * torch.tensor([0.01, 0.01, 1.0])
    leaves = with_gradients(scene)
    render = draw(leaves, camera, backend=backend)
    assert not render.visible[:6].any()
    expected = draw({name: value[6:] for name, value in scene.items()}, camera, backend=backend)
    assert torch.equal(render.image, expected.image)
    torch.autograd.backward(render.image.sum())
    for gradient in gradients_of(leaves).values():
        assert (gradient[:6] == 0).all()
        assert gradient.isfinite().all()


def test_a_place_that_overflows_is_dropped(backend: str) -> None:
    camera = make_camera()
    scene = make_scene(8, camera, seed=1, dtype=torch.float32)
    scene["means"][0] = torch.tensor([3e38, 3e38, 3e38])
    scene["scales"][0] = 1e37
    leaves = with_gradients(scene)
    render = draw(leaves, camera, backend=backend)
    assert not render.visible[0]
    torch.autograd.backward(render.image.sum())
    assert all(gradient.isfinite().all() for gradient in gradients_of(leaves).values())
    expected = draw({name: value[1:] for name, value in scene.items()}, camera, backend=backend)
    assert torch.equal(render.image, expected.image)


def test_a_singular_covariance_is_dropped(backend: str, pixel: Camera) -> None:
    scene = single_pixel(2, opacity=0.5)
    scene["scales"][0] = 0  # a point, which without dilation has no inverse covariance
    render = draw(scene, pixel, RasterSettings(eps2d=0.0), sh_degree=0, backend=backend)
    assert render.visible.tolist() == [False, True]
    assert render.alpha.item() == 0.5


def test_a_box_that_only_touches_the_image_is_not_visible(pixel: Camera) -> None:
    # At an opacity of exactly alpha_min the box is the mean itself, px; the image is 1 x 1 px.
    scene = single_pixel(1, opacity=0.5)
    for x, y, visible in (
        (0.0, 0.5, False),
        (1.0, 0.5, False),
        (0.5, 0.0, False),
        (0.9, 0.1, True),
    ):
        offset = torch.tensor([[x - 0.5, y - 0.5]])
        raster = RasterSettings(alpha_min=0.5)
        render = draw(scene, pixel, raster, sh_degree=0, means2d_offset=offset)
        assert render.visible.tolist() == [visible]


@pytest.mark.parametrize("count", [0, 5])
def test_none_or_none_visible_shows_the_background(backend: str, count: int) -> None:
    camera = make_camera()
    scene = with_gradients(make_scene(count, camera, dtype=torch.float32))
    with torch.no_grad():
        scene["means"][:, 2] = -1
    render = draw(scene, camera, RasterSettings(background=(0.1, 0.2, 0.3)), backend=backend)
    assert torch.equal(render.image, torch.tensor([0.1, 0.2, 0.3]).expand(14, 20, 3))
    assert torch.equal(render.alpha, torch.zeros(14, 20))
    assert render.visible.tolist() == [False] * count
    assert render.evaluations == 0
    torch.autograd.backward(render.image.sum())  # as a training step does
    assert all((gradient == 0).all() for gradient in gradients_of(scene).values())
