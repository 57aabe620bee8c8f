"""The culling of the compiled rasterizer: each kind changes the work and not the image."""

from __future__ import annotations

from dataclasses import fields
from functools import cache
from typing import Any

import pytest
import torch
from torch import Tensor

from tests.splat.scenes import Scene, draw, gradients_of, make_camera, make_scene, with_gradients
from xrgs.splat.cameras import Camera
from xrgs.splat.gaussians import ActivatedGaussians
from xrgs.splat.rendering import Render
from xrgs.splat.settings import CullingOptions, RasterSettings

pytest.importorskip("xrgs._native")


def render_with(
    culling: CullingOptions, scene: Scene, camera: Camera
) -> tuple[Render, Scene, dict[str, int]]:
    """The render, its gradients, and the work that each kind of culling lessens."""
    from xrgs.splat.native.rasterizer import render

    leaves = with_gradients(scene)
    gaussians = ActivatedGaussians(**leaves)
    done = render(gaussians, camera, RasterSettings(), 3, None, culling=culling)
    graph: Any = done.image.grad_fn
    frame = graph.frame
    work = {
        "out_of_view": int(done.visible.sum()),
        "sub_threshold": int(done.visible.sum()),
        "tiles": frame.pair_count,
        "blocks": done.evaluations,
        "saturated": done.evaluations,
    }
    torch.autograd.backward(done.image.square().sum())
    return done, gradients_of(leaves), work


NAMES = [*(field.name for field in fields(CullingOptions)), "all"]


def crowd(camera: Camera, count: int, size: float) -> tuple[Scene, Camera]:
    """Gaussians of which each kind of culling leaves out some, and their camera in float32."""
    camera = Camera(camera.viewmat.float(), camera.K.float(), camera.width, camera.height)
    scene = make_scene(count, camera, seed=14, size=size, dtype=torch.float32)
    scene["opacities"][::3] = 0.99
    faint = scene["opacities"][1::9]
    faint[:] = torch.linspace(0, 1 / 255, len(faint))
    scene["scales"][::4, 0] *= 8
    scene["means"][::50] -= 100 * camera.viewmat[0, :3]  # far to the left
    return scene, camera


@cache
def crowd_and_truth(where: str) -> tuple[Scene, Camera, Tensor]:
    """1,500 Gaussians, their camera, and the image in float64, which takes seconds.

    `far` is the image of 500 px at the right end of one of 4,500, where float32 coordinates are
    coarse.
    """
    if where == "near":
        scene, camera = crowd(make_camera(60, 50, focal=60.0, turned=True), 1500, 3.0)
    else:
        scene, camera = crowd(make_camera(500, 20, focal=60.0), 1500, 3.0)
        K = camera.K.clone()
        K[0, 2] += 4000
        camera = Camera(camera.viewmat, K, 4500, 20)
    exact = draw({key: value.double() for key, value in scene.items()}, camera)
    return scene, camera, exact.image


@pytest.mark.slow
@pytest.mark.parametrize(
    ("where", "name"),
    [*(("near", name) for name in NAMES), pytest.param("far", "all", marks=pytest.mark.slow)],
)
def test_culling_makes_no_difference(isa: str, where: str, name: str) -> None:
    """Compare renders with and without a kind of culling, or all, with each other and the truth."""
    scene, camera, truth = crowd_and_truth(where)
    names = [field.name for field in fields(CullingOptions)] if name == "all" else [name]
    usual, usual_gradients, usual_work = render_with(CullingOptions(), scene, camera)
    done, gradients, work = render_with(
        CullingOptions(**dict.fromkeys(names, False)), scene, camera
    )
    assert torch.equal(done.image, usual.image)
    assert torch.equal(done.alpha, usual.alpha)
    for key, gradient in gradients.items():
        error = (gradient - usual_gradients[key]).norm()
        assert error <= 1e-5 * usual_gradients[key].norm(), key
        assert (gradient[~usual.visible] == 0).all(), key
    for culled in names:
        assert work[culled] > usual_work[culled], culled
    error = (done.image.double() - truth).abs().detach()
    assert error.mean() <= 1e-6
    assert error.max() <= 2e-3


def test_tile_evaluations_are_those_without_the_culling_inside_tiles() -> None:
    # The image has whole tiles: pixels beyond its edge are counted and never computed.
    scene, camera = crowd(make_camera(64, 48, focal=60.0, turned=True), 1500, 3.0)
    every_pixel, _, _ = render_with(CullingOptions(blocks=False, saturated=False), scene, camera)
    usual, _, _ = render_with(CullingOptions(), scene, camera)
    assert usual.tile_evaluations == every_pixel.tile_evaluations == every_pixel.evaluations
    assert 0 < usual.evaluations < usual.tile_evaluations
