"""The compiled rasterizer's promises beside its numbers, which test_rasterizer.py tests.

These are the same bits each time and on any number of threads, errors that name what is wrong, and
renders that do not disturb one another.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor

from tests.splat.scenes import Scene, make_camera, make_scene
from xrgs.splat.cameras import Camera
from xrgs.splat.gaussians import ActivatedGaussians
from xrgs.splat.native.rasterizer import render_config
from xrgs.splat.rendering import Render, rasterize_parameters
from xrgs.splat.settings import CullingOptions, RasterSettings

native = pytest.importorskip("xrgs._native")

NAMES = ("means", "quats", "scales", "opacities", "sh0", "shN")


def render(scene: Scene, camera: Camera) -> tuple[Render, list[Tensor]]:
    """The render, and the leaves that its gradients go to."""
    leaves = {name: scene[name].clone().requires_grad_() for name in NAMES}
    offset = torch.zeros(len(leaves["means"]), 2, requires_grad=True)
    made = rasterize_parameters(
        *ActivatedGaussians(**leaves),
        camera,
        RasterSettings(),
        sh_degree=3,
        means2d_offset=offset,
        backend="native",
    )
    return made, [*leaves.values(), offset]


def config_of(camera: Camera, sh_degree: int = 3) -> Any:
    return render_config(camera, RasterSettings(), sh_degree, CullingOptions())


def gradient(leaf: Tensor) -> Tensor:
    assert leaf.grad is not None
    return leaf.grad


# --- the same each time -------------------------------------------------------------------------


@pytest.fixture(scope="module")
def large() -> tuple[Scene, Camera]:
    """Enough Gaussians and tiles for every stage to be cut into several tasks."""
    camera = make_camera(150, 110, focal=120.0, turned=True)
    return make_scene(20_000, camera, seed=12, size=2.0, dtype=torch.float32), camera


def everything(large: tuple[Scene, Camera], count: int) -> tuple[Render, list[Tensor]]:
    torch.set_num_threads(count)
    scene, camera = large
    v_image = torch.linspace(-1, 1, camera.height * camera.width * 3).reshape(camera.height, -1, 3)
    made, leaves = render(scene, camera)
    torch.autograd.backward((made.image * v_image).sum() + (made.alpha * v_image[..., 0]).sum())
    return made, [made.image, made.alpha, made.visible, *(gradient(leaf) for leaf in leaves)]


def test_any_number_of_threads_gives_the_same_bits(
    threads: None, isa: str, large: tuple[Scene, Camera]
) -> None:
    first, expected = everything(large, 1)
    for count in (1, 2, 4, 3):
        again, results = everything(large, count)
        assert all(torch.equal(a, b) for a, b in zip(expected, results, strict=True))
        assert again.evaluations == first.evaluations


def test_renders_alive_at_once_keep_apart() -> None:
    camera = make_camera(40, 30)
    scenes = [make_scene(100, camera, seed=seed, dtype=torch.float32) for seed in range(3)]

    def gradient_of_means(made: Render, leaves: list[Tensor]) -> Tensor:
        torch.autograd.backward(made.image.sum())
        return gradient(leaves[0])

    alone = [gradient_of_means(*render(scene, camera)) for scene in scenes]
    together = [render(scene, camera) for scene in scenes]
    for expected, rendered in zip(reversed(alone), reversed(together), strict=True):
        assert torch.equal(gradient_of_means(*rendered), expected)


def test_harmonics_whose_gradient_is_not_wanted_is_not_computed(isa: str) -> None:
    camera = make_camera(turned=True)
    scene = make_scene(45, camera, dtype=torch.float32)
    gradients: dict[bool, dict[str, Tensor | None]] = {}
    for wanted in (True, False):
        leaves = {name: scene[name].clone().requires_grad_() for name in NAMES}
        leaves["shN"].requires_grad_(wanted)
        gaussians = ActivatedGaussians(**leaves)
        render = rasterize_parameters(
            *gaussians, camera, RasterSettings(), sh_degree=3, backend="native"
        )
        torch.autograd.backward(render.image.square().sum())
        gradients[wanted] = {name: leaf.grad for name, leaf in leaves.items()}
    assert gradients[True].pop("shN") is not None
    assert gradients[False].pop("shN") is None
    assert gradients[False].keys() == gradients[True].keys()
    for name, gradient in gradients[True].items():
        other = gradients[False][name]
        assert gradient is not None
        assert other is not None
        assert torch.equal(other, gradient), name


def test_a_forked_child_renders(large: tuple[Scene, Camera]) -> None:
    scene, camera = large
    values, view = [scene[name] for name in NAMES], config_of(camera)

    def image() -> bytes:
        # Only our threads: torch's own do not outlive a fork.
        rendered: bytes = native.Frame().forward(view, *values, None, 2)[0].numpy().tobytes()
        return rendered

    expected = image()
    child = os.fork()
    if child == 0:
        signal.alarm(20)
        os._exit(0 if image() == expected else 1)
    assert os.waitpid(child, 0)[1] == 0


# --- bad input ----------------------------------------------------------------------------------


def test_shapes_are_checked() -> None:
    camera = make_camera()
    scene = make_scene(10, camera, dtype=torch.float32)
    values = [scene[key] for key in NAMES]
    frame = native.Frame()
    with pytest.raises(ValueError, match="opacities must have 10 rows, got 9"):
        frame.forward(config_of(camera), *values[:3], values[3][:9], *values[4:], None, 1)
    with pytest.raises(ValueError, match="shN has fewer bands"):
        frame.forward(config_of(camera), *values[:5], values[5][:, :8].contiguous(), None, 1)
    with pytest.raises(ValueError, match="shN must have at most 15 bands, got 24"):
        frame.forward(config_of(camera), *values[:5], torch.zeros(10, 24, 3), None, 1)
    with pytest.raises(ValueError, match="sh_degree"):
        config_of(camera, sh_degree=4)
    frame.forward(config_of(camera), *values, None, 1)
    with pytest.raises(ValueError, match="image's size"):
        frame.backward(torch.zeros(3, 3, 3), torch.zeros(3, 3), *values, None, True, 1)
    v_image, v_alpha = torch.zeros(camera.height, camera.width, 3), torch.zeros(camera.height, 20)
    for bands, says in ((24, "at most 15 bands"), (8, "fewer bands")):
        values[5] = torch.zeros(10, bands, 3)
        with pytest.raises(ValueError, match=says):
            frame.backward(v_image, v_alpha, *values, None, True, 1)


def test_a_frame_without_a_render_is_refused() -> None:
    camera = make_camera()
    scene = make_scene(10, camera, dtype=torch.float32)
    values = [scene[key] for key in NAMES]
    v_image, v_alpha = torch.zeros(camera.height, camera.width, 3), torch.zeros(camera.height, 20)
    frame = native.Frame()
    uses: list[Callable[[], object]] = [
        frame.visible,
        lambda: frame.evaluations,
        lambda: frame.pair_count,
        lambda: frame.bytes,
        lambda: frame.timings,
        lambda: frame.backward(v_image, v_alpha, *values, None, True, 1),
    ]

    def assert_all_refused() -> None:
        for use in uses:
            with pytest.raises(ValueError, match="the frame has no render"):
                use()

    assert_all_refused()
    frame.forward(config_of(camera), *values, None, 1)
    for use in uses:
        use()
    values[0] = torch.full((10, 3), torch.nan)
    with pytest.raises(ValueError, match="means has values that are not finite"):
        frame.forward(config_of(camera), *values, None, 1)
    values[0] = scene["means"]
    assert_all_refused()


AFTER_FAILURE = """
import resource, torch
from xrgs.splat.cameras import Camera
from xrgs.splat.native.rasterizer import render_config
from xrgs.splat.rendering import rasterize_parameters
from xrgs.splat.settings import RasterSettings

def render(n):
    means = torch.tensor([0.0, 0.0, 1.0]).repeat(n, 1)
    scene = [means, torch.ones(n, 4), torch.full((n, 3), 100.0), torch.full((n,), 0.5)]
    scene += [torch.zeros(n, 1, 3), torch.zeros(n, 0, 3)]
    K = torch.tensor([[400.0, 0, 400], [0, 400, 400], [0, 0, 1]])
    camera = Camera(torch.eye(4), K, 800, 800)
    made = rasterize_parameters(*scene, camera, RasterSettings(), sh_degree=0, backend="native")
    return made.image.clone()

torch.set_num_threads(1)
before = render(100)
used = int(open("/proc/self/statm").read().split()[0]) * resource.getpagesize()
resource.setrlimit(resource.RLIMIT_AS, (used + (200 << 20), resource.RLIM_INFINITY))
for _ in range(3):
    try:
        render(6000)  # 15 million pairs
    except MemoryError as error:
        print(error)
print(torch.equal(render(100), before))
"""


@pytest.mark.skipif(not os.path.exists("/proc/self/statm"), reason="reads Linux's /proc")  # noqa: PTH110
@pytest.mark.slow
def test_lists_beyond_memory_are_a_clear_error_and_leave_no_trace() -> None:
    result = subprocess.run(
        [sys.executable, "-P", "-c", AFTER_FAILURE],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    *errors, equal = result.stdout.splitlines() or [""]
    assert equal == "True", (result.returncode, result.stdout, result.stderr)
    assert len(errors) == 3
    says = "the lists of 6000 visible Gaussians in 800x800 px do not fit"
    assert all(says in error for error in errors)


@pytest.mark.parametrize(("value", "says"), [("portable", "portable"), ("sse9", "XRGS_ISA")])
def test_the_environment_chooses_the_instruction_set(value: Any, says: str) -> None:
    result = subprocess.run(
        [sys.executable, "-P", "-c", "from xrgs import _native; print(_native.isa())"],
        env=os.environ | {"XRGS_ISA": value},
        capture_output=True,
        text=True,
        check=False,
    )
    assert says in (result.stdout if value == "portable" else result.stderr)
