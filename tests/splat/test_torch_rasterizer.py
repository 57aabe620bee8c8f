"""The renderer against a splatter written per pixel in numpy, and against finite differences."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import sph_harm_y

from xrgs.splat import torch_rasterizer
from xrgs.splat.cameras import Camera
from xrgs.splat.rasterize import rasterize
from xrgs.splat.settings import RasterSettings

NAMES = ("means", "quats", "scales", "opacities", "sh0", "shN")
NO_CUTS = RasterSettings(alpha_min=0.0, alpha_max=1.0, transmittance_min=0.0)


def draw(scene, camera, raster=None, *, sh_degree=3, **options):
    values = (scene[name] for name in NAMES)
    return rasterize(*values, camera, raster or RasterSettings(), sh_degree=sh_degree, **options)


def with_gradients(scene):
    return {name: value.clone().requires_grad_() for name, value in scene.items()}


# --- the naive splatter -------------------------------------------------------------------------


def naive_color(direction, coeffs):
    """Real spherical harmonics from scipy's complex ones."""
    x, y, z = direction / np.linalg.norm(direction)
    color = np.full(3, 0.5)
    for index in range(len(coeffs)):
        degree = int(index**0.5)
        order = index - degree * degree - degree
        value = sph_harm_y(degree, abs(order), np.arccos(z), np.arctan2(y, x))
        real = value.real if order >= 0 else value.imag
        color += (real if order == 0 else np.sqrt(2) * real) * coeffs[index]
    return np.maximum(color, 0)


def naive_rotation(quat):
    if not quat.any():
        return np.eye(3)
    w, x, y, z = quat / np.linalg.norm(quat)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + 2 * w * cross + 2 * cross @ cross


def naive_splats(scene, camera, raster):
    """Depth, index, mean, inverse covariance, opacity and colour of all in front of the camera."""
    viewmat, K = camera.viewmat.numpy(), camera.K.numpy()
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    splats = []
    for i in range(len(scene["means"])):
        mean, quat, scale = (scene[n][i].detach().numpy() for n in ("means", "quats", "scales"))
        x, y, z = viewmat[:3, :3] @ mean + viewmat[:3, 3]
        if z <= raster.near:
            continue
        margin_x, margin_y = 0.15 * camera.width / fx, 0.15 * camera.height / fy
        tx = z * np.clip(x / z, -cx / fx - margin_x, (camera.width - cx) / fx + margin_x)
        ty = z * np.clip(y / z, -cy / fy - margin_y, (camera.height - cy) / fy + margin_y)
        J = np.array([[fx / z, 0, -fx * tx / z**2], [0, fy / z, -fy * ty / z**2]])
        half = J @ viewmat[:3, :3] @ naive_rotation(quat) @ np.diag(scale)
        cov = half @ half.T
        dilated = cov + raster.eps2d * np.eye(2)
        opacity = float(scene["opacities"][i])
        if raster.antialiased:
            opacity *= np.sqrt(max(0, np.linalg.det(cov) / np.linalg.det(dilated)))
        coeffs = torch.cat([scene["sh0"][i], scene["shN"][i]]).detach().numpy()
        color = naive_color(mean - camera.position.numpy(), coeffs)
        place = np.array([fx * x / z + cx, fy * y / z + cy])
        splats.append((z, i, place, np.linalg.inv(dilated), opacity, color))
    return sorted(splats, key=lambda splat: splat[:2])


def naive(scene, camera, raster):
    image = np.zeros((camera.height, camera.width, 3))
    alphas = np.zeros((camera.height, camera.width))
    splats = naive_splats(scene, camera, raster)
    for row in range(camera.height):
        for column in range(camera.width):
            left = 1.0
            for _, _, place, conic, opacity, color in splats:
                d = np.array([column + 0.5, row + 0.5]) - place
                alpha = min(raster.alpha_max, opacity * np.exp(-0.5 * d @ conic @ d))
                if alpha < raster.alpha_min:
                    continue
                if left * (1 - alpha) <= raster.transmittance_min:
                    break
                image[row, column] += left * alpha * color
                left *= 1 - alpha
            image[row, column] += left * np.array(raster.background)
            alphas[row, column] = 1 - left
    return image, alphas


@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize(
    "raster",
    [
        RasterSettings(),
        RasterSettings(background=(0.2, 0.5, 0.9)),
        RasterSettings(antialiased=True, eps2d=0.1),
        RasterSettings(alpha_min=0.1, alpha_max=0.5, transmittance_min=0.2),
        NO_CUTS,
    ],
    ids=["default", "background", "antialiased", "hard cuts", "no cuts"],
)
def test_image_is_the_naive_splatters(make_camera, make_scene, raster, seed):
    camera = make_camera(turned=bool(seed))
    scene = make_scene(40, camera, seed=seed, size=2.5)
    scene["opacities"][::3] = 1.0
    scene["scales"][::5, 0] *= 10
    scene["quats"][0] = 0
    render = draw(scene, camera, raster)
    image, alpha = naive(scene, camera, raster)
    np.testing.assert_allclose(render.image, image, atol=1e-10)
    np.testing.assert_allclose(render.alpha, alpha, atol=1e-10)
    assert np.std(image) > 0.05


@pytest.mark.parametrize(("width", "height"), [(1, 1), (1, 9), (17, 1), (8, 8), (9, 7), (16, 24)])
def test_sizes_that_are_no_multiple_of_a_tile(make_camera, make_scene, width, height):
    camera = make_camera(width, height)
    scene = make_scene(12, camera, seed=width, size=3.0)
    render = draw(scene, camera)
    assert render.image.shape == (height, width, 3)
    np.testing.assert_allclose(render.image, naive(scene, camera, RasterSettings())[0], atol=1e-10)


def test_pixel_centres_are_at_a_half():
    camera = Camera(torch.eye(4), torch.tensor([[10.0, 0, 3.5], [0, 10, 2.5], [0, 0, 1]]), 8, 6)
    scene = single_pixel(1, opacity=0.5)
    alpha = draw(scene, camera, sh_degree=0).alpha
    assert alpha[2, 3] == alpha.max()
    torch.testing.assert_close(alpha[2, 2], alpha[2, 4])
    torch.testing.assert_close(alpha[1, 3], alpha[3, 3])


# --- gradients ----------------------------------------------------------------------------------


@pytest.mark.parametrize("antialiased", [False, True])
def test_gradients_are_finite_differences_with_the_cuts_off(make_camera, make_scene, antialiased):
    camera = make_camera(6, 5, turned=True)
    raster = RasterSettings(
        alpha_min=0.0,
        alpha_max=1.0,
        transmittance_min=0.0,
        antialiased=antialiased,
        background=(0.3, 0.6, 0.1),
    )
    scene = make_scene(4, camera, seed=3, degree=1, size=2.0)
    scene["sh0"] = 2 + scene["sh0"].abs()  # away from the clamp of colours at 0
    scene["means"][0] = camera.position + 1.5 * (scene["means"][0] - camera.position)
    offset = torch.zeros(4, 2, dtype=torch.float64)
    inputs = [value.requires_grad_() for value in (*with_gradients(scene).values(), offset)]

    def outputs(*values):
        *parameters, means2d_offset = values
        render = rasterize(*parameters, camera, raster, sh_degree=1, means2d_offset=means2d_offset)
        return render.image, render.alpha

    assert torch.autograd.gradcheck(outputs, inputs)


def test_gradients_with_the_cuts_on_are_directional_differences(make_camera, make_scene):
    camera = make_camera()
    raster = RasterSettings(background=(0.9, 0.2, 0.5))
    scene = make_scene(60, camera, seed=7, size=3.0)
    scene["opacities"][::2] = 0.99 + 0.005 * scene["opacities"][::2]
    weights = torch.randn(14, 20, 3, dtype=torch.float64)

    def loss(values):
        return (draw(values, camera, raster).image * weights).sum()

    leaves = with_gradients(scene)
    loss(leaves).backward()
    for name in NAMES:
        direction = torch.randn_like(scene[name])
        ahead, behind = (
            loss(scene | {name: scene[name] + sign * 1e-7 * direction}) for sign in (1, -1)
        )
        difference = (ahead - behind) / 2e-7
        exact = (leaves[name].grad * direction).sum()
        torch.testing.assert_close(exact, difference, rtol=1e-5, atol=1e-6)


def test_background_reaches_the_gradients_of_what_stands_before_it(make_camera, make_scene):
    """Its term of alpha's gradient, alone: black Gaussians before a bright background."""
    camera = make_camera()
    raster = RasterSettings(background=(1.0, 2.0, 3.0))
    scene = make_scene(10, camera, seed=2)
    scene["sh0"][:] = -10
    leaves = with_gradients(scene)
    draw(leaves, camera, raster, sh_degree=0).image.sum().backward()
    for i in range(10):
        step = torch.zeros(10, dtype=torch.float64)
        step[i] = 1e-7
        ahead, behind = (
            draw(scene | {"opacities": scene["opacities"] + s}, camera, raster, sh_degree=0)
            for s in (step, -step)
        )
        difference = (ahead.image.sum() - behind.image.sum()) / 2e-7
        torch.testing.assert_close(leaves["opacities"].grad[i], difference, rtol=1e-5, atol=1e-5)
    assert leaves["opacities"].grad.min() < -1


def test_offset_moves_the_means_and_gathers_the_image_plane_gradient(make_camera, make_scene):
    camera = make_camera()
    scene = make_scene(30, camera, seed=4)
    # Specks, whose shape does not depend on where the Jacobian is clamped: then an offset of the
    # means is one of the principal point.
    scene["scales"] = torch.full_like(scene["scales"], 1e-3)
    shift = torch.tensor([1.0, 2.0], dtype=torch.float64)
    K = camera.K.clone()
    K[:2, 2] += shift
    shifted = draw(scene, Camera(camera.viewmat, K, camera.width, camera.height))
    offset = shift.expand(30, 2).clone().requires_grad_()
    by_offset = draw(scene, camera, means2d_offset=offset)
    torch.testing.assert_close(by_offset.image, shifted.image, atol=1e-5, rtol=0)
    by_offset.image.square().sum().backward()
    assert (offset.grad[by_offset.visible] != 0).any()
    assert (offset.grad[~by_offset.visible] == 0).all()


def test_absgrad_sums_the_absolute_gradients_of_single_pixels(make_camera, make_scene):
    camera = make_camera(11, 9)  # two tiles by two
    scene = make_scene(12, camera, seed=5, size=3.0)
    generator = torch.Generator().manual_seed(0)
    v_image = torch.randn(9, 11, 3, generator=generator, dtype=torch.float64)
    v_alpha = torch.randn(9, 11, generator=generator, dtype=torch.float64)

    def values(*, absgrad):
        leaves = with_gradients(scene)
        leaves["means2d_offset"] = torch.full((12, 2), 0.3, dtype=torch.float64).requires_grad_()
        raster = RasterSettings(absgrad=absgrad)
        render = draw(leaves, camera, raster, means2d_offset=leaves["means2d_offset"])
        return leaves, (render.image * v_image).sum(-1) + render.alpha * v_alpha  # [H, W]

    leaves, plain = values(absgrad=False)
    expected = torch.zeros(12, 2, dtype=torch.float64)
    for pixel in plain.flatten():
        (gradient,) = torch.autograd.grad(pixel, leaves["means2d_offset"], retain_graph=True)
        expected += gradient.abs()
    plain.sum().backward()
    absolute, total = values(absgrad=True)
    torch.testing.assert_close(total, plain)
    total.sum().backward()
    torch.testing.assert_close(absolute["means2d_offset"].grad, expected)
    assert (expected.sum() > 1.5 * leaves["means2d_offset"].grad.abs().sum()).all()
    for name in NAMES:
        torch.testing.assert_close(absolute[name].grad, leaves[name].grad)


# --- compositing's rules, on one pixel ----------------------------------------------------------


def single_pixel(count, *, opacity, dtype=torch.float32):
    """Wide Gaussians behind one another on the optical axis, the first nearest."""
    means = torch.zeros(count, 3, dtype=dtype)
    means[:, 2] = 1 + torch.arange(count, dtype=dtype)
    return {
        "means": means,
        "quats": torch.tensor([[1.0, 0, 0, 0]], dtype=dtype).repeat(count, 1),
        "scales": torch.full((count, 3), 0.1, dtype=dtype),
        "opacities": torch.full((count,), opacity, dtype=dtype),
        "sh0": torch.ones(count, 1, 3, dtype=dtype),
        "shN": torch.zeros(count, 0, 3, dtype=dtype),
    }


@pytest.fixture
def pixel():
    """The camera whose only pixel's centre is the optical axis."""
    K = torch.tensor([[10.0, 0, 0.5], [0, 10, 0.5], [0, 0, 1]], dtype=torch.float64)
    return Camera(torch.eye(4, dtype=torch.float64), K, 1, 1)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_pixel_ends_before_the_gaussian_that_leaves_too_little(pixel, dtype):
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


def test_a_capped_alpha_has_no_gradient(pixel):
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
def test_a_contribution_below_the_cut_is_skipped(pixel, opacity, seen):
    render = draw(single_pixel(1, opacity=opacity), pixel, sh_degree=0)
    assert (render.alpha > 0).item() == seen
    assert render.visible.tolist() == [seen]


@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
def test_of_equal_depths_the_lower_index_is_in_front(pixel, order):
    scene = single_pixel(2, opacity=0.9)
    scene["means"][:, 2] = 2.0
    scene["sh0"] = torch.tensor([[[1.0, 0, -9]], [[-9.0, 0, 1]]])[list(order)]
    red, _, blue = draw(scene, pixel, sh_degree=0).image[0, 0]
    assert (red > 5 * blue) if order == (0, 1) else (blue > 5 * red)


def test_opacity_one_without_a_cap_is_opaque(pixel):
    leaves = with_gradients(single_pixel(3, opacity=1.0, dtype=torch.float64))
    raster = RasterSettings(alpha_max=1.0, transmittance_min=-1.0)
    render = draw(leaves, pixel, raster, sh_degree=0)
    torch.testing.assert_close(render.alpha.item(), 1.0)
    render.image.sum().backward()
    assert all(torch.isfinite(leaves[name].grad).all() for name in NAMES)


# --- what is not seen ---------------------------------------------------------------------------


def test_behind_or_nearer_than_near_is_not_seen_and_has_no_gradient(make_camera, make_scene):
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
    for name in NAMES:
        assert (leaves[name].grad[:6] == 0).all()
        assert torch.isfinite(leaves[name].grad).all()


def test_a_covariance_that_overflows_is_dropped(make_camera, make_scene):
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
    assert all(torch.isfinite(leaves[name].grad).all() for name in NAMES)
    expected = draw({name: value[4:] for name, value in scene.items()}, camera)
    assert torch.equal(render.image, expected.image)


@pytest.mark.parametrize("count", [0, 5])
def test_none_or_none_visible_shows_the_background(make_camera, make_scene, count):
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


# --- how it is done makes no difference ---------------------------------------------------------


def test_tiles_and_batches_make_no_difference(make_camera, make_scene, monkeypatch):
    camera = make_camera(33, 21)
    scene = make_scene(80, camera, seed=9, size=3.0)
    renders = []
    for tile, elements in ((8, 1 << 18), (4, 1 << 18), (16, 1 << 18), (64, 1 << 18), (8, 1)):
        monkeypatch.setattr(torch_rasterizer, "BATCH_ELEMENTS", elements)
        leaves = with_gradients(scene)
        values = (leaves[name] for name in NAMES)
        render = torch_rasterizer.render(*values, camera, RasterSettings(), 3, None, tile=tile)
        render.image.square().sum().backward()
        renders.append((render.image, *(leaves[name].grad for name in NAMES)))
    for other in renders[1:]:
        for ours, theirs in zip(renders[0], other, strict=True):
            torch.testing.assert_close(ours, theirs, rtol=1e-11, atol=1e-11)


def test_float32_is_float64_outside_a_band_around_the_thresholds(make_camera, make_scene):
    camera = make_camera(40, 30, turned=True)
    scene = make_scene(300, camera, seed=11, size=3.0)
    scene["scales"][::9, 0] *= 20
    scene = {name: value.float().double() for name, value in scene.items()}
    exact = draw(scene, camera).image
    single = draw({name: value.float() for name, value in scene.items()}, camera).image.double()
    base = RasterSettings()
    band = torch.zeros(30, 40, dtype=torch.bool)
    for factor in (1 - 1e-4, 1 + 1e-4):
        for name in ("alpha_min", "transmittance_min"):
            near = RasterSettings(**{name: getattr(base, name) * factor})
            band |= (draw(scene, camera, near).image != exact).any(-1)
    error = (single - exact).abs().amax(-1)
    assert band.float().mean() < 0.1
    assert error[~band].max() < 2e-5
    assert error.max() < 2 * base.alpha_min * exact.max()


def test_render_is_the_same_twice(make_camera, make_scene):
    camera = make_camera()
    scene = make_scene(50, camera, dtype=torch.float32)
    results = []
    for _ in range(2):
        leaves = with_gradients(scene)
        render = draw(leaves, camera)
        render.image.sum().backward()
        results.append([render.image, *(leaves[name].grad for name in NAMES)])
    assert all(torch.equal(a, b) for a, b in zip(*results, strict=True))


@given(
    seed=st.integers(0, 2**31),
    count=st.integers(0, 30),
    width=st.integers(1, 24),
    height=st.integers(1, 24),
    stretch=st.floats(-25, 25),
    dtype=st.sampled_from([torch.float32, torch.float64]),
    antialiased=st.booleans(),
)
@settings(max_examples=40, deadline=None)
def test_random_scenes(
    make_camera, make_scene, seed, count, width, height, stretch, dtype, antialiased
):
    camera = make_camera(width, height, turned=bool(seed % 2))
    scene = make_scene(count, camera, seed=seed, dtype=dtype)
    scene["scales"][::2, 0] *= float(np.exp(stretch))
    scene["means"][1::3] -= 2 * (scene["means"][1::3] - camera.position.to(dtype))  # behind
    raster = RasterSettings(antialiased=antialiased, background=(1.0, 1.0, 1.0))
    scene["sh0"][:] = 0.5 / 0.28209479177387814
    scene["shN"][:] = 0
    leaves = with_gradients(scene)
    render = draw(leaves, camera, raster)
    # All white before white is white, whatever hides what.
    torch.testing.assert_close(
        render.image, torch.ones(height, width, 3, dtype=dtype), atol=2e-6, rtol=0
    )
    assert ((render.alpha >= 0) & (render.alpha < 1)).all()
    assert not render.visible[1::3].any()
    render.image.square().mean().backward()
    for name in NAMES:
        assert torch.isfinite(leaves[name].grad).all()
        assert (leaves[name].grad[~render.visible] == 0).all()


# --- what it took -------------------------------------------------------------------------------


def test_evaluations_are_list_lengths_times_pixels(pixel):
    render = draw(single_pixel(3, opacity=0.5), pixel, sh_degree=0)
    assert render.evaluations == 3 * torch_rasterizer.TILE**2


@pytest.mark.parametrize("absgrad", [False, True])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_bytes_of_a_batch_are_what_autograd_keeps(dtype, absgrad):
    entries = torch.rand(3, 50, 11 if absgrad else 9, dtype=dtype).requires_grad_()
    corner = torch.zeros(3, 2, dtype=dtype)
    kept = {}

    def keep(tensor):
        storage = tensor.untyped_storage()
        if tensor.numel() >= 3 * 50 * 64:
            kept[storage.data_ptr()] = tensor.numel() * tensor.element_size()
        return tensor

    with torch.autograd.graph.saved_tensors_hooks(keep, lambda tensor: tensor):
        torch_rasterizer.composite(entries, corner, 8, RasterSettings(absgrad=absgrad))
    per_alpha = torch_rasterizer.alpha_bytes(dtype.itemsize, absgrad=absgrad)
    assert sum(kept.values()) == 3 * 50 * 64 * per_alpha


def test_buffer_bytes_grow_with_the_lists(make_camera, make_scene):
    camera = make_camera()
    few, many = (
        draw(make_scene(count, camera, dtype=torch.float32), camera) for count in (10, 400)
    )
    assert few.buffer_bytes > 14 * 20 * 4 * 4
    assert many.buffer_bytes > 5 * few.buffer_bytes
