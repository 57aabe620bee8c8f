"""Projection and culling against gsplat's own torch implementation and closed forms."""

from __future__ import annotations

from collections.abc import Sequence

import pytest
import torch
from gsplat.cuda._torch_impl import _fully_fused_projection, _quat_scale_to_covar_preci
from torch import Tensor

from tests.splat.scenes import Scene, make_camera, make_scene
from xrgs.splat.cameras import Camera
from xrgs.splat.settings import RasterSettings
from xrgs.splat.torch.projection import conic_cholesky, depths, project, visible_by_depth

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


@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("turned", [False, True])
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


def one(
    mean: Sequence[float],
    scales: Sequence[float] = (0.1, 0.2, 0.3),
    quat: Sequence[float] = (1.0, 0.2, -0.3, 0.4),
    dtype: torch.dtype = torch.float64,
) -> Scene:
    """One Gaussian's parameters, at a place and of a shape."""
    values = {"means": mean, "quats": quat, "scales": scales}
    scene = {name: torch.tensor([value], dtype=dtype) for name, value in values.items()}
    return scene | {"opacities": torch.tensor([0.5], dtype=dtype)}


@pytest.mark.parametrize("side", [-1, 1])
@pytest.mark.parametrize("axis", [0, 1])
def test_jacobian_is_clamped_at_1_3_of_the_field_around_the_principal_point(
    axis: int, side: int
) -> None:
    camera = make_camera()
    focal = camera.K[axis, axis]
    size = (camera.width, camera.height)[axis]
    border = (camera.K[axis, 2] if side < 0 else size - camera.K[axis, 2]) / focal
    limit = side * (border + 0.3 * 0.5 * size / focal)
    covariances = []
    for slope in (limit, 1.5 * limit, 4 * limit, 0.9 * limit):
        mean = [0.0, 0.0, 2.0]
        mean[axis] = float(2 * slope)
        covariances.append(project(*shape_of(one(mean)), camera, RasterSettings()).cov)
    at_limit, beyond, far_beyond, within = covariances
    torch.testing.assert_close(beyond, at_limit, rtol=1e-12, atol=0)
    torch.testing.assert_close(far_beyond, at_limit, rtol=1e-12, atol=0)
    assert (within - at_limit).abs().max() > 1e-3


@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("slope", [-4.0, -0.1, 0.2, 3.0])
def test_gradient_within_and_beyond_the_clamp(slope: float, antialiased: bool) -> None:
    camera = make_camera(turned=False)
    settings = RasterSettings(antialiased=antialiased)
    scene = one([2 * slope, -1.5 * slope, 2.0])
    inputs = [value.requires_grad_() for value in shape_of(scene)]
    assert torch.autograd.gradcheck(
        lambda m, q, s, o: project(m, q, s, o, camera, settings), inputs
    )


def test_needle_determinant_does_not_cancel() -> None:
    camera = make_camera(width=1000, height=800, focal=900.0)
    needle = one([0.1, 0.2, 1.5], scales=(8.0, 1e-4, 1e-4), quat=(0.9, 0.1, 0.2, 0.35))
    exact = project(*shape_of(needle), camera, RasterSettings())
    rounded = {name: value.float() for name, value in needle.items()}
    single = project(*shape_of(rounded), camera, RasterSettings())
    assert exact.cov[0, 0] > 100**2
    torch.testing.assert_close(single.det.double(), exact.det, rtol=1e-4, atol=0)
    xx, xy, yy = single.cov[0]
    assert abs((xx * yy - xy * xy) / exact.det[0] - 1) > 0.01, "the plain formula would do"
    factor = conic_cholesky(single).double()
    torch.testing.assert_close(factor, conic_cholesky(exact), rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("scales", [(0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (1e-30, 1e-30, 1e-30)])
@pytest.mark.parametrize("antialiased", [False, True])
def test_projected_gaussians_have_finite_gradients(
    scales: tuple[float, float, float], antialiased: bool
) -> None:
    scene = one([0.1, 0.1, 2.0], scales=scales, dtype=torch.float32)
    inputs = [value.requires_grad_() for value in shape_of(scene)]
    settings = RasterSettings(antialiased=antialiased)
    projected = project(*shape_of(scene), make_camera(), settings)
    assert projected.det >= 0.09 * (1 - 1e-6)
    total = torch.stack([output.sum() for output in projected]).sum()
    assert all(gradient.isfinite().all() for gradient in torch.autograd.grad(total, inputs))


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


def test_the_cholesky_factor_is_of_half_the_conic() -> None:
    camera = make_camera()
    projected = project(*shape_of(make_scene(50, camera)), camera, RasterSettings())
    xx, xy, yy = projected.cov.unbind(-1)
    conics = torch.linalg.inv(torch.stack([xx, xy, xy, yy], dim=-1).reshape(-1, 2, 2))
    expected = torch.linalg.cholesky(conics / 2, upper=True)  # [50, 2, 2]
    factor = conic_cholesky(projected)
    torch.testing.assert_close(
        factor,
        torch.stack([expected[:, 0, 0], expected[:, 0, 1], expected[:, 1, 1]], dim=-1),
        rtol=1e-9,
        atol=1e-12,
    )
