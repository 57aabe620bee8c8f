"""The compiled rasterizer's promises beside its numbers, which test_rasterizer.py tests.

These are errors that name what is wrong, and renders that do not disturb one another.
"""

from __future__ import annotations

import os
import resource
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from tests.splat.scenes import (
    Scene,
    draw,
    gradients_of,
    make_camera,
    make_scene,
    single_pixel,
    with_gradients,
)
from xrgs.splat.cameras import Camera
from xrgs.splat.gaussians import PARAMETERS, Gaussians
from xrgs.splat.native.rasterizer import render_config
from xrgs.splat.rendering import Render, rasterize_parameters, zero_means2d_offset
from xrgs.splat.settings import CullingOptions, RasterSettings

native = pytest.importorskip("xrgs._native")


def config_of(camera: Camera, sh_degree: int = 3) -> Any:
    return render_config(camera, RasterSettings(), sh_degree, CullingOptions())


# --- renders ------------------------------------------------------------------------------------


def test_renders_alive_at_once_keep_apart() -> None:
    camera = make_camera(40, 30)
    scenes = [make_scene(100, camera, seed=seed, dtype=torch.float32) for seed in range(3)]

    def render(scene: Scene) -> tuple[Render, Scene]:
        leaves = with_gradients(scene)
        return draw(leaves, camera, backend="native"), leaves

    def gradient_of_means(made: Render, leaves: Scene) -> Tensor:
        torch.autograd.backward(made.image.sum())
        return gradients_of(leaves)["means"]

    alone = [gradient_of_means(*render(scene)) for scene in scenes]
    together = [render(scene) for scene in scenes]
    for expected, rendered in zip(reversed(alone), reversed(together), strict=True):
        assert torch.equal(gradient_of_means(*rendered), expected)


def test_harmonics_whose_gradient_is_not_wanted_is_not_computed() -> None:
    camera = make_camera(turned=True)
    scene = make_scene(45, camera, dtype=torch.float32)
    gradients = []
    for wanted in (True, False):
        leaves = with_gradients(scene)
        leaves["shN"].requires_grad_(wanted)
        torch.autograd.backward(draw(leaves, camera, backend="native").image.square().sum())
        assert (leaves.pop("shN").grad is not None) == wanted
        gradients.append(gradients_of(leaves))
    assert all(torch.equal(gradients[0][name], gradients[1][name]) for name in gradients[0])


def holds_in_forked_child(check: Callable[[], bool]) -> bool:
    """Whether a check holds in a forked child, which has only our threads: torch's end there."""
    child = os.fork()
    if child == 0:
        signal.alarm(60)
        holds = False
        try:
            holds = check()
        finally:
            os._exit(not holds)
    return os.waitpid(child, 0)[1] == 0


def test_a_forked_child_renders() -> None:
    """20,000 Gaussians: enough for every stage to be cut into several tasks."""
    camera = make_camera(150, 110, focal=120.0, turned=True)
    scene = make_scene(20_000, camera, seed=12, size=2.0, dtype=torch.float32)

    def image() -> bytes:
        frame = native.Frame().forward(config_of(camera), *scene.values(), None, 2)
        rendered: bytes = frame[0].numpy().tobytes()
        return rendered

    expected = image()
    assert holds_in_forked_child(lambda: image() == expected)


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="reads Linux's /proc")
def test_lists_beyond_memory_are_a_clear_error_and_leave_no_trace() -> None:
    """60,000 Gaussians that cover 800 x 800 px have 150 million pairs.

    Earlier tests leave some hundred MiB free inside the process, which a limit on the address space
    does not take away: the lists must be far larger. The parameters exist before the limit does.
    """

    def scene_of(count: int) -> Scene:
        return single_pixel(count, opacity=0.5) | {"scales": torch.full((count, 3), 1e6)}

    def image(scene: Scene) -> Tensor:
        rendered: Tensor = native.Frame().forward(config, *scene.values(), None, 1)[0]
        return rendered

    def check() -> bool:
        used = int(Path("/proc/self/statm").read_text("utf-8").split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (used + (100 << 20), resource.RLIM_INFINITY))
        for _ in range(2):
            with pytest.raises(
                MemoryError, match=r"the lists of 60000 visible Gaussians in 800x800"
            ):
                image(large)
        return torch.equal(image(small), expected)

    config = config_of(make_camera(800, 800, focal=400.0), sh_degree=0)
    large, small = scene_of(60_000), scene_of(100)
    expected = image(small)
    assert holds_in_forked_child(check)


# --- raw parameters, which the projection activates itself --------------------------------------


def raw_scene(count: int) -> Gaussians:
    """Gaussians in view and around it, as leaves."""
    scene = make_scene(count, make_camera(), dtype=torch.float32)
    scene["scales"] = scene["scales"].log()
    scene["opacities"] = scene["opacities"].logit()
    return Gaussians(**{name: value.requires_grad_() for name, value in scene.items()})


def results(count: int, settings: RasterSettings, degree: int, *, raw: bool) -> list[Tensor]:
    """Image, alpha, visible Gaussians, and the gradients of the raw parameters and the offset."""
    gaussians, offset = raw_scene(count), zero_means2d_offset(count)
    made = rasterize_parameters(
        *(gaussians.raw() if raw else gaussians.activated(backend="native")),
        make_camera(),
        settings,
        sh_degree=degree,
        means2d_offset=offset,
        raw=raw,
        backend="native",
    )
    torch.autograd.backward((made.image * made.image.detach().cos()).sum() + made.alpha.sum())
    leaves = {name: gaussians[name] for name in PARAMETERS if name != "shN"} | {"offset": offset}
    gradients = gradients_of(leaves)
    assert all(gradient.any() for gradient in gradients.values())
    return [made.image.detach(), made.alpha.detach(), made.visible, *gradients.values()]


@pytest.mark.parametrize(
    ("count", "degree", "varied"), [(17, 0, True), (32, 1, False), (333, 3, True)]
)
def test_the_bits_of_raw_parameters_are_those_of_activated_ones(
    isa: str, count: int, degree: int, varied: bool
) -> None:
    settings = RasterSettings(antialiased=varied, absgrad=varied)
    raw, activated = (results(count, settings, degree, raw=raw) for raw in (True, False))
    assert all(torch.equal(a, b) for a, b in zip(raw, activated, strict=True))


@pytest.mark.parametrize(
    ("name", "value"),
    [("scales", 89.0), ("scales", torch.inf), ("scales", torch.nan), ("opacities", torch.nan)],
)
def test_a_raw_value_that_float32_does_not_hold_is_named(name: str, value: float) -> None:
    gaussians = raw_scene(20)
    gaussians[name].data.view(-1)[7] = value
    with pytest.raises(ValueError, match=f"^{name} has values that are not finite"):
        rasterize_parameters(
            *gaussians.raw(),
            make_camera(),
            RasterSettings(),
            sh_degree=3,
            raw=True,
            backend="native",
        )


# --- bad input ----------------------------------------------------------------------------------


def test_shapes_are_checked() -> None:
    camera = make_camera()
    values = list(make_scene(10, camera, dtype=torch.float32).values())
    frame = native.Frame()
    with pytest.raises(ValueError, match="opacities must have 10 rows, got 9"):
        frame.forward(config_of(camera), *values[:3], values[3][:9], *values[4:], None, 1)
    with pytest.raises(ValueError, match="sh_degree"):
        config_of(camera, sh_degree=4)
    with pytest.raises(ValueError, match="the frame has no render"):
        frame.visible()
    frame.forward(config_of(camera), *values, None, 1)
    with pytest.raises(ValueError, match="image's size"):
        frame.backward(torch.zeros(3, 3, 3), torch.zeros(3, 3), *values, None, True, 1)
    v_image, v_alpha = torch.zeros(camera.height, camera.width, 3), torch.zeros(camera.height, 20)
    for bands, says in ((24, "at most 15 bands"), (8, "fewer bands")):
        values[5] = torch.zeros(10, bands, 3)
        with pytest.raises(ValueError, match=says):
            native.Frame().forward(config_of(camera), *values, None, 1)
        with pytest.raises(ValueError, match=says):
            frame.backward(v_image, v_alpha, *values, None, True, 1)
