"""What composes a pixel and what is not seen, rule by rule."""

from __future__ import annotations

import pytest
import torch

from xrgs.splat.gaussians import PARAMETERS
from xrgs.splat.settings import RasterSettings

# --- compositing, on one pixel --------------------------------------------------------------------


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_pixel_ends_before_the_gaussian_that_leaves_too_little(
    draw, with_gradients, single_pixel, pixel, dtype
):
    scene = single_pixel(6, opacity=0.95, dtype=dtype)
    scene["opacities"][4:] = 0.01  # these would leave enough, but the pixel has ended
    leaves = with_gradients(scene)
    render = draw(leaves, pixel, sh_degree=0)
    torch.testing.assert_close(render.alpha, torch.full((1, 1), 1 - 0.05**3, dtype=dtype))
    render.image.sum().backward()
    assert (leaves["opacities"].grad[:3] > 0).all()
    assert (leaves["sh0"].grad[:3] > 0).all()
    assert (leaves["opacities"].grad[3:] == 0).all()
    assert (leaves["sh0"].grad[3:] == 0).all()


def test_a_capped_alpha_has_no_gradient(draw, with_gradients, single_pixel, pixel):
    leaves = with_gradients(single_pixel(2, opacity=0.995, dtype=torch.float64))
    with torch.no_grad():
        leaves["opacities"][1] = 0.5
    render = draw(leaves, pixel, sh_degree=0)
    torch.testing.assert_close(render.alpha[0, 0].item(), 1 - 0.01 * 0.5)
    render.image.sum().backward()
    for name in ("means", "quats", "scales", "opacities"):
        assert (leaves[name].grad[0] == 0).all()
    assert leaves["opacities"].grad[1] != 0
    assert (leaves["sh0"].grad[0] > 0).all()


@pytest.mark.parametrize(("opacity", "seen"), [(0.99 / 255, False), (1.01 / 255, True)])
def test_a_contribution_below_the_cut_is_skipped(draw, single_pixel, pixel, opacity, seen):
    render = draw(single_pixel(1, opacity=opacity), pixel, sh_degree=0)
    assert (render.alpha > 0).item() == seen
    assert render.visible.tolist() == [seen]


@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
def test_of_equal_depths_the_lower_index_is_in_front(draw, single_pixel, pixel, order):
    scene = single_pixel(2, opacity=0.9)
    scene["means"][:, 2] = 2.0
    scene["sh0"] = torch.tensor([[[1.0, 0, -9]], [[-9.0, 0, 1]]])[list(order)]
    red, _, blue = draw(scene, pixel, sh_degree=0).image[0, 0]
    assert (red > 5 * blue) if order == (0, 1) else (blue > 5 * red)


def test_opacity_one_without_a_cap_is_opaque(draw, with_gradients, single_pixel, pixel):
    leaves = with_gradients(single_pixel(3, opacity=1.0, dtype=torch.float64))
    raster = RasterSettings(alpha_max=1.0, transmittance_min=-1.0)
    render = draw(leaves, pixel, raster, sh_degree=0)
    torch.testing.assert_close(render.alpha.item(), 1.0)
    render.image.sum().backward()
    assert all(torch.isfinite(leaves[name].grad).all() for name in PARAMETERS)


# --- what is not seen ---------------------------------------------------------------------------


def test_behind_or_nearer_than_near_is_not_seen_and_has_no_gradient(
    draw, with_gradients, make_camera, make_scene
):
    camera = make_camera()
    scene = make_scene(8, camera, seed=1, dtype=torch.float32)
    depths = torch.tensor([-3.0, -1e-3, 0.0, 1e-30, 0.009, 0.01])
    scene["means"][:6] = depths[:, None] * torch.tensor([0.01, 0.01, 1.0])
    leaves = with_gradients(scene)
    render = draw(leaves, camera)
    assert not render.visible[:6].any()
    expected = draw({name: value[6:] for name, value in scene.items()}, camera)
    assert torch.equal(render.image, expected.image)
    render.image.sum().backward()
    for name in PARAMETERS:
        assert (leaves[name].grad[:6] == 0).all()
        assert torch.isfinite(leaves[name].grad).all()


def test_a_covariance_that_overflows_is_dropped(draw, with_gradients, make_camera, make_scene):
    camera = make_camera()
    scene = make_scene(8, camera, seed=1, dtype=torch.float32)
    scene["scales"][0] = 1e30
    scene["scales"][1, 2] = 3e38
    scene["means"][2] = torch.tensor([3e38, 3e38, 3e38])
    scene["scales"][3] = 1e12  # the covariance has room, its determinant has not
    leaves = with_gradients(scene)
    render = draw(leaves, camera)
    assert not render.visible[:4].any()
    render.image.sum().backward()
    assert all(torch.isfinite(leaves[name].grad).all() for name in PARAMETERS)
    expected = draw({name: value[4:] for name, value in scene.items()}, camera)
    assert torch.equal(render.image, expected.image)


@pytest.mark.parametrize("count", [0, 5])
def test_none_or_none_visible_shows_the_background(
    draw, with_gradients, make_camera, make_scene, count
):
    camera = make_camera()
    scene = with_gradients(make_scene(count, camera, dtype=torch.float32))
    with torch.no_grad():
        scene["means"][:, 2] = -1
    render = draw(scene, camera, RasterSettings(background=(0.1, 0.2, 0.3)))
    assert torch.equal(render.image, torch.tensor([0.1, 0.2, 0.3]).expand(14, 20, 3))
    assert torch.equal(render.alpha, torch.zeros(14, 20))
    assert render.visible.tolist() == [False] * count
    assert render.evaluations == 0
    render.image.sum().backward()  # a step of training must go through
    assert all((value.grad == 0).all() for value in scene.values())
