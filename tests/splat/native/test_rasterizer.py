"""The compiled rasterizer against the torch one in double, whose own tests are in ../torch."""

from __future__ import annotations

import math
from collections import defaultdict
from dataclasses import replace
from statistics import median
from typing import Any

import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st
from torch import Tensor

from tests.splat.native.oracle import compare, run
from tests.splat.scenes import Scene, make_camera, make_scene
from xrgs.splat.cameras import Camera
from xrgs.splat.gaussians import PARAMETERS
from xrgs.splat.rendering import Render
from xrgs.splat.settings import RasterSettings

pytest.importorskip("xrgs._native")

GRADIENT_FLOOR = 2e-6
"""Of a gradient's norm: below this an error is rounding, whoever makes it."""


def rounded(camera: Camera) -> Camera:
    """The camera in numbers that float32 has."""
    return Camera(camera.viewmat.float(), camera.K.float(), camera.width, camera.height)


def single(scene: Scene) -> Scene:
    return {name: value.float() for name, value in scene.items()}


def check(
    scene: Scene, camera: Camera, raster: RasterSettings | None = None, **options: Any
) -> tuple[Render, Scene, Tensor]:
    """Compare image, alpha, visibility and gradients with the oracle's."""
    raster = raster or RasterSettings()
    ours, gradients, exact, band = compare(single(scene), rounded(camera), raster, **options)
    off = gradients["shN"][:, (options.get("sh_degree", 3) + 1) ** 2 - 1 :]
    assert (off == 0).all()
    error = (ours.image.double() - exact.image).abs().detach()
    assert error.mean() <= 1e-6 * max(1.0, float(exact.image.detach().max()))
    assert torch.equal(ours.visible, exact.visible)
    return ours, gradients, band


# --- against the oracle -------------------------------------------------------------------------


@pytest.mark.parametrize("sh_degree", [0, 3])
def test_a_plain_scene(isa: str, sh_degree: int) -> None:
    camera = make_camera(50, 37, turned=True)
    scene = make_scene(300, camera, seed=1)
    ours, gradients, band = check(scene, camera, sh_degree=sh_degree, floor=GRADIENT_FLOOR)
    assert (gradients["shN"] != 0).any() == (sh_degree > 0)
    assert band.float().mean() < 0.1
    assert ours.image.max() > 0.3
    assert 0 < ours.evaluations < 300 * 50 * 37
    assert ours.buffer_bytes > 300 * 64


def test_antialiased_before_a_background(isa: str) -> None:
    camera = make_camera(40, 30)
    raster = RasterSettings(antialiased=True, background=(0.2, 0.5, 0.9))
    scene = make_scene(300, camera, seed=2, size=0.7)
    scene["scales"][::5] *= 1e-3  # the compensation leaves little or nothing of these
    check(scene, camera, raster, sh_degree=1)


@pytest.mark.parametrize("opacity", [0.02, 0.9, 1.0])
def test_many_layers(isa: str, opacity: float) -> None:
    # More than two batches of Gaussians in a tile; where opaque, pixels end and alphas are capped.
    camera = make_camera(16, 16, focal=15.0)
    scene = make_scene(600, camera, seed=3, size=4.0)
    scene["opacities"][:] = opacity
    check(scene, camera)


def test_without_cuts(isa: str) -> None:
    camera = make_camera()
    raster = RasterSettings(alpha_min=0.0, alpha_max=1.0, transmittance_min=0.0)
    check(make_scene(30, camera, seed=4), camera, raster)


def test_beyond_the_field_of_view(isa: str) -> None:
    # Large ones whose centres are far outside, where the Jacobian is held.
    camera = make_camera(turned=True)
    scene = make_scene(200, camera, seed=6, size=12.0)
    inward = scene["means"] - camera.position
    scene["means"] = camera.position + inward * torch.tensor([1.8, 1.9, 1.0], dtype=torch.float64)
    ours, _, _ = check(scene, camera, sh_degree=2)
    assert ours.visible.sum() > 20


@pytest.mark.parametrize("antialiased", [False, True])
def test_beyond_the_field_of_view_at_the_near_plane(isa: str, antialiased: bool) -> None:
    # Small ones whose slopes are held, where a step towards the camera changes them most.
    camera = make_camera(turned=True)
    scene = make_scene(200, camera, seed=16, size=1.0)
    in_camera = (scene["means"] @ camera.viewmat[:3, :3].T) + camera.viewmat[:3, 3]
    depth = torch.linspace(0.0095, 0.03, 200, dtype=torch.float64)
    share = depth / in_camera[:, 2]
    slopes = in_camera[:, :2] / in_camera[:, 2:] * 1.5
    in_camera = torch.cat([slopes * depth[:, None], depth[:, None]], dim=1)
    scene["means"] = (in_camera - camera.viewmat[:3, 3]) @ camera.viewmat[:3, :3]
    scene["scales"] *= 4 * share[:, None]
    raster = RasterSettings(antialiased=antialiased, background=(0.3, 0.6, 0.1))
    ours, _, _ = check(scene, camera, raster)
    half = torch.tensor([camera.width, camera.height]) / camera.K.diagonal()[:2] / 2
    held = (slopes.abs() > 1.7 * half).any(dim=1)
    assert (ours.visible & held).sum() > 10
    assert not ours.visible[depth < 0.00999].any()


@pytest.mark.parametrize("near", [0.0, -1.0])
def test_a_near_plane_at_the_camera_or_behind(isa: str, near: float) -> None:
    camera = make_camera()
    scene = make_scene(60, camera, seed=5)
    depths = torch.tensor([-2.0, -0.5, -0.1, 0.0, 1e-4, 1e-3, 0.02], dtype=torch.float64)
    scene["means"][: len(depths), :2] *= depths[:, None] / 3
    scene["means"][: len(depths), 2] = depths
    scene["scales"][: len(depths)] = 0.05 * depths.abs()[:, None]
    ours, _, _ = check(scene, camera, RasterSettings(near=near))
    expected = (depths > near) & (depths != 0)
    assert torch.equal(ours.visible[: len(depths)], expected)


def test_needles(isa: str) -> None:
    camera = make_camera(60, 40, turned=True)
    scene = make_scene(60, camera, seed=7, size=1.0)
    scene["scales"][::2, 0] *= 30
    scene["scales"][1::2, 0] *= 3000
    scene["scales"][:, 1:] *= 1e-3
    check(scene, camera)


def test_flat_and_huge(isa: str) -> None:
    camera = make_camera()
    scene = make_scene(50, camera, seed=9)
    scene["scales"][::4] = 0
    scene["scales"][3::8] = 1e4
    scene["opacities"][::10] = 0
    check(scene, camera)


@pytest.mark.parametrize(
    ("width", "height", "count"),
    [(1, 1, 17), (1, 33, 16), (33, 1, 15), (16, 16, 1), (17, 15, 17)],
)
def test_sizes(isa: str, width: int, height: int, count: int) -> None:
    camera = make_camera(width, height)
    check(make_scene(count, camera, seed=width + count), camera)


@pytest.mark.slow
def test_absgrad(isa: str) -> None:
    camera = make_camera(50, 37, turned=True)
    scene = make_scene(300, camera, seed=13, size=3.0)
    raster = RasterSettings(antialiased=True, background=(0.3, 0.6, 0.1))
    _, plain, _ = check(scene, camera, raster)
    _, absolute, _ = check(scene, camera, replace(raster, absgrad=True))
    for name in PARAMETERS:
        assert torch.equal(absolute[name], plain[name]), name
    offset = plain["means2d_offset"].abs()
    assert (absolute["means2d_offset"] >= offset - 1e-4 * offset.max()).all()
    assert absolute["means2d_offset"].sum() > 1.5 * offset.sum()


def needle(length: float, width: float, seed: int) -> tuple[Scene, Camera]:
    """One Gaussian of this size in px, in the middle of an image of 320 px."""
    size, depth = 320, 2.0
    K = torch.tensor([[size, 0, size / 2], [0, size, size / 2], [0, 0, 1]])
    generator = torch.Generator().manual_seed(seed)
    half_angle = 0.15 + 0.5 * torch.rand(1, generator=generator).item()
    scene = {
        "means": torch.tensor([[0.03, 0.02, depth]]),
        "quats": torch.tensor([[math.cos(half_angle), 0.02, 0.01, math.sin(half_angle)]]),
        "scales": torch.tensor([[length, width, width]]) * depth / size,
        "opacities": torch.tensor([0.9]),
        "sh0": torch.randn(1, 1, 3, generator=generator),
        "shN": torch.zeros(1, 15, 3),
    }
    return scene, Camera(torch.eye(4), K, size, size)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("length", "width", "antialiased"), [(100, 0.3, True), (1000, 0.05, False)]
)
def test_gradients_of_needles_are_as_exact_as_float32_in_torch(
    length: float, width: float, antialiased: bool
) -> None:
    """Gaussians of up to 1,000 px, three times as long as the image is wide, in many directions.

    In the median at most twice torch's error, which is about 1e-5 for all parameters.
    """
    raster = RasterSettings(
        antialiased=antialiased, alpha_min=1e-6, alpha_max=1.0, transmittance_min=0.0
    )
    errors: defaultdict[tuple[str, str], list[float]] = defaultdict(list)
    for seed in range(20):
        scene, camera = needle(length, width, seed)
        generator = torch.Generator().manual_seed(seed)
        v_image = torch.randn(320, 320, 3, generator=generator)
        v = v_image, torch.randn(320, 320, generator=generator)
        _, expected = run(scene, camera, raster, "torch", torch.float64, v)
        for backend in ("native", "torch"):
            _, got = run(scene, camera, raster, backend, torch.float32, v)
            for name in ("means", "quats", "scales", "opacities", "sh0"):
                error = (got[name] - expected[name]).norm() / expected[name].norm()
                errors[backend, name].append(float(error))
    for _, name in errors:
        assert median(errors["native", name]) <= 2 * median(errors["torch", name]), name


@pytest.mark.slow
@given(
    seed=st.integers(0, 2**31),
    count=st.integers(0, 80),
    width=st.integers(1, 40),
    height=st.integers(1, 40),
    size=st.floats(0.1, 20.0),
    stretch=st.floats(0.05, 20.0),
    antialiased=st.booleans(),
)
@example(seed=1, count=1, width=1, height=1, size=3.25, stretch=2.25, antialiased=False)  # cancels
@settings(max_examples=25)
def test_random_scenes(
    seed: int, count: int, width: int, height: int, size: float, stretch: float, antialiased: bool
) -> None:
    camera = make_camera(width, height, turned=bool(seed % 2))
    scene = make_scene(count, camera, seed=seed, size=size)
    scene["scales"][::2, 0] *= stretch
    scene["means"][1::7] -= 2 * (scene["means"][1::7] - camera.position)  # behind
    check(scene, camera, RasterSettings(antialiased=antialiased, background=(0.3, 0.6, 0.1)))


def test_a_large_scene_is_within_the_bounds() -> None:
    camera = rounded(make_camera(150, 110, focal=120.0, turned=True))
    scene = single(make_scene(20_000, camera, seed=12, size=2.0))
    images = [
        run(scene, camera, RasterSettings(), backend, dtype)[0].image.detach().double()
        for backend, dtype in (("native", torch.float32), ("torch", torch.float64))
    ]
    error = (images[0] - images[1]).abs()
    assert error.mean() <= 1e-6
    assert error.max() <= 2e-3
