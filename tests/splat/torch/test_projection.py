import pytest
import torch
from gsplat.cuda._torch_impl import _fully_fused_projection, _quat_scale_to_covar_preci

from xrgs.splat.cameras import Camera
from xrgs.splat.settings import RasterSettings
from xrgs.splat.torch.projection import conic_cholesky, depths, project, visible_by_depth

SHAPE = ("means", "quats", "scales", "opacities")


def ours(scene, camera, settings):
    """means2d, conics, depths and the factor of the opacity, as gsplat returns them."""
    flat = project(*(scene[name] for name in SHAPE), camera, settings)
    xx, xy, yy = flat.cov.unbind(-1)
    conics = torch.stack([yy, -xy, xx], dim=-1) / flat.det[:, None]
    return flat.means2d, conics, flat.depths, flat.opacities / scene["opacities"]


def gsplats(scene, camera, settings):
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
def test_projection_and_its_gradient_are_gsplats(make_camera, make_scene, antialiased, turned):
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
        loss = sum(
            (o * torch.randn(o.shape, generator=generator, dtype=o.dtype)).sum() for o in outputs
        )
        names = ("means", "quats", "scales")
        results.append((outputs, torch.autograd.grad(loss, [scene[name] for name in names])))
    for mine, theirs in zip(results[0][0], results[1][0], strict=True):
        torch.testing.assert_close(mine, theirs, rtol=1e-8, atol=1e-10)
    for mine, theirs in zip(results[0][1], results[1][1], strict=True):
        torch.testing.assert_close(mine, theirs, rtol=1e-7, atol=1e-8)


@pytest.fixture
def one(make_camera):
    """One Gaussian's parameters, at a place and of a shape."""

    def make(mean, scales=(0.1, 0.2, 0.3), quat=(1.0, 0.2, -0.3, 0.4), dtype=torch.float64):
        values = {"means": mean, "quats": quat, "scales": scales}
        scene = {name: torch.tensor([value], dtype=dtype) for name, value in values.items()}
        return scene | {"opacities": torch.tensor([0.5], dtype=dtype)}

    return make


@pytest.mark.parametrize("side", [-1, 1])
@pytest.mark.parametrize("axis", [0, 1])
def test_jacobian_is_clamped_at_1_3_of_the_field_around_the_principal_point(
    make_camera, one, axis, side
):
    camera = make_camera()
    focal = camera.K[axis, axis]
    size = (camera.width, camera.height)[axis]
    border = (camera.K[axis, 2] if side < 0 else size - camera.K[axis, 2]) / focal
    limit = side * (border + 0.3 * 0.5 * size / focal)
    covariances = []
    for slope in (limit, 1.5 * limit, 4 * limit, 0.9 * limit):
        mean = [0.0, 0.0, 2.0]
        mean[axis] = float(2 * slope)
        covariances.append(project(*one(mean).values(), camera, RasterSettings()).cov)
    at_limit, beyond, far_beyond, within = covariances
    torch.testing.assert_close(beyond, at_limit, rtol=1e-12, atol=0)
    torch.testing.assert_close(far_beyond, at_limit, rtol=1e-12, atol=0)
    assert (within - at_limit).abs().max() > 1e-3


@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("slope", [-4.0, -0.1, 0.2, 3.0])
def test_gradient_within_and_beyond_the_clamp(make_camera, one, slope, antialiased):
    camera = make_camera(turned=False)
    settings = RasterSettings(antialiased=antialiased)
    scene = one([2 * slope, -1.5 * slope, 2.0])
    inputs = [value.requires_grad_() for value in scene.values()]
    assert torch.autograd.gradcheck(lambda *args: project(*args, camera, settings), inputs)


def test_needle_determinant_does_not_cancel(make_camera, one):
    camera = make_camera(width=1000, height=800, focal=900.0)
    needle = one([0.1, 0.2, 1.5], scales=(8.0, 1e-4, 1e-4), quat=(0.9, 0.1, 0.2, 0.35))
    exact = project(*needle.values(), camera, RasterSettings())
    single = project(*(v.float() for v in needle.values()), camera, RasterSettings())
    assert exact.cov[0, 0] > 100**2
    torch.testing.assert_close(single.det.double(), exact.det, rtol=1e-4, atol=0)
    xx, xy, yy = single.cov[0]
    assert abs((xx * yy - xy * xy) / exact.det[0] - 1) > 0.01, "the plain formula would do"
    factor = conic_cholesky(single).double()
    torch.testing.assert_close(factor, conic_cholesky(exact), rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("scales", [(0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (1e-30, 1e-30, 1e-30)])
@pytest.mark.parametrize("antialiased", [False, True])
def test_flat_gaussians_have_finite_gradients(make_camera, one, scales, antialiased):
    scene = one([0.1, 0.1, 2.0], scales=scales, dtype=torch.float32)
    inputs = [value.requires_grad_() for value in scene.values()]
    settings = RasterSettings(antialiased=antialiased)
    flat = project(*inputs, make_camera(), settings)
    assert flat.det >= 0.09 * (1 - 1e-6)
    sum(output.sum() for output in flat).backward()
    assert all(torch.isfinite(value.grad).all() for value in inputs)


def test_visible_is_the_box_of_reach_against_the_image(make_camera):
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
    flat = project(*scene.values(), camera, settings)
    visible = visible_by_depth(flat, camera, settings)
    assert (flat.depths[visible].diff() >= 0).all()
    expected = set()
    for i in range(count):
        opacity = float(flat.opacities[i])
        if opacity < settings.alpha_min:
            continue
        reach = (2 * torch.log(flat.opacities[i] / settings.alpha_min)).sqrt()
        x, y = flat.means2d[i]
        rx, ry = reach * flat.cov[i, 0].sqrt(), reach * flat.cov[i, 2].sqrt()
        if x + rx > 0 and x - rx < camera.width and y + ry > 0 and y - ry < camera.height:
            expected.add(i)
    assert set(visible.tolist()) == expected
    assert 100 < len(expected) < count - 100


def test_equal_depths_keep_their_order(make_camera):
    camera = Camera(torch.eye(4), torch.diag(torch.tensor([9.0, 9.0, 1.0])), 40, 40)
    generator = torch.Generator().manual_seed(0)
    means = torch.rand(100, 3, generator=generator)
    means[:, 2] = torch.arange(100) % 3 + 1.0
    scales, quats = torch.full((100, 3), 0.1), torch.ones(100, 4)
    flat = project(means, quats, scales, torch.ones(100), camera, RasterSettings())
    order = visible_by_depth(flat, camera, RasterSettings()).tolist()
    assert order == sorted(range(100), key=lambda i: (i % 3, i))
