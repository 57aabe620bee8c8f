"""Projection and culling against gsplat's own torch implementation and closed forms."""

from __future__ import annotations

import pytest
import torch
from gsplat.cuda._torch_impl import _fully_fused_projection, _quat_scale_to_covar_preci
from torch import Tensor

from tests.splat.scenes import Scene, make_camera, make_scene
from xrgs.splat.cameras import Camera
from xrgs.splat.settings import RasterSettings
from xrgs.splat.torch.projection import depths, project, visible_by_depth

Outputs = tuple[Tensor, Tensor, Tensor, Tensor]

SHAPE = ("means", "quats", "scales", "opacities")


def shape_of(scene: Scene) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    return scene["means"], scene["quats"], scene["scales"], scene["opacities"]


def ours(scene: Scene, camera: Camera, settings: RasterSettings) -> Outputs:
    """means2d, conics, depths and the factor of the opacity, as gsplat returns them."""
    projected = project(*shape_of(scene), camera, settings)
    xx, xy, yy = projected.cov.unbind(-1)
    conics = torch.stack([yy, -xy, xx], dim=-1) / projected.det[:, None]
    return projected.means2d, conics, projected.depths, projected.opacities / scene["opacities"]


def gsplats(scene: Scene, camera: Camera, settings: RasterSettings) -> Outputs:
    covars, _ = _quat_scale_to_covar_preci(scene["quats"], scene["scales"], compute_preci=False)
    _, means2d, depths, conics, factor = _fully_fused_projection(
        scene["means"],
        covars,
        camera.viewmat[None],
        camera.K[None],
        camera.width,
        camera.height,
        eps2d=settings.eps2d,
        calc_compensations=settings.antialiased,
    )
    ones = torch.ones_like(depths[0])
    return means2d[0], conics[0], depths[0], factor[0] if factor is not None else ones


@pytest.mark.parametrize(("antialiased", "turned"), [(False, True), (True, False)])
def test_projection_and_its_gradient_are_gsplats(antialiased: bool, turned: bool) -> None:
    camera = make_camera(turned=turned)
    settings = RasterSettings(antialiased=antialiased)
    scene = make_scene(200, camera, size=3.0)
    # A third lies far beyond the image, where the Jacobian is clamped.
    centre = camera.position
    scene["means"][::3] += 3 * (scene["means"][::3] - scene["means"].mean(0))
    scene["means"] = scene["means"][depths(scene["means"], camera) > 0.1]
    count = len(scene["means"])
    assert count > 100
    assert (scene["means"] - centre).norm(dim=-1).min() > 0.1
    scene = {name: scene[name][:count].requires_grad_() for name in SHAPE}
    generator = torch.Generator().manual_seed(1)
    results = []
    for method in (ours, gsplats):
        outputs = method(scene, camera, settings)
        generator.manual_seed(1)
        weights = [torch.randn(o.shape, generator=generator, dtype=o.dtype) for o in outputs]
        loss = torch.stack([(o * w).sum() for o, w in zip(outputs, weights, strict=True)]).sum()
        names = ("means", "quats", "scales")
        results.append((outputs, torch.autograd.grad(loss, [scene[name] for name in names])))
    for mine, theirs in zip(results[0][0], results[1][0], strict=True):
        torch.testing.assert_close(mine, theirs, rtol=1e-8, atol=1e-10)
    for mine, theirs in zip(results[0][1], results[1][1], strict=True):
        torch.testing.assert_close(mine, theirs, rtol=1e-7, atol=1e-8)


def test_visible_is_the_bounding_box_against_the_image() -> None:
    camera = make_camera()
    settings = RasterSettings()
    generator = torch.Generator().manual_seed(0)
    count = 4000
    means = torch.randn(count, 3, generator=generator, dtype=torch.float64) * 2
    means[:, 2] = 1 + means[:, 2].abs()
    scene = {
        "means": means,
        "quats": torch.randn(count, 4, generator=generator, dtype=torch.float64),
        "scales": 0.2 * torch.rand(count, 3, generator=generator, dtype=torch.float64),
        "opacities": 0.02 * torch.rand(count, generator=generator, dtype=torch.float64),
    }
    projected = project(*shape_of(scene), camera, settings)
    visible = visible_by_depth(projected, camera, settings)
    assert (projected.depths[visible].diff() >= 0).all()
    expected = set()
    for i in range(count):
        opacity = float(projected.opacities[i])
        if opacity < settings.alpha_min:
            continue
        radius = (2 * torch.log(projected.opacities[i] / settings.alpha_min)).sqrt()
        x, y = projected.means2d[i]
        rx, ry = radius * projected.cov[i, 0].sqrt(), radius * projected.cov[i, 2].sqrt()
        if x + rx > 0 and x - rx < camera.width and y + ry > 0 and y - ry < camera.height:
            expected.add(i)
    assert set(visible.tolist()) == expected
    assert 100 < len(expected) < count - 100
