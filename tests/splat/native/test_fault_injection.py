"""Every allocation of the compiled module made to fail in turn: an error, and no harm done.

Only a build with fault injection can do this; `tests/csrc/sanitize.sh` makes one and runs this.
"""

from __future__ import annotations

import contextlib
import itertools
import subprocess
import sys
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from tests.splat.scenes import make_camera, make_scene
from xrgs.splat.gaussians import PARAMETERS
from xrgs.splat.native.rasterizer import render_config
from xrgs.splat.native.resample import banded_matrix
from xrgs.splat.settings import CullingOptions, RasterSettings

Results = list[Tensor]

native = pytest.importorskip("xrgs._native")
pytestmark = pytest.mark.skipif(
    not hasattr(native, "fail_allocation"), reason="the module is built without fault injection"
)

THREADS = 2


def assert_every_failure_is_an_error(run: Callable[[], Results], at_least: int) -> None:
    """Let allocation 1, 2, ... of a call fail until there are no more.

    Each failure must be a MemoryError, after which the same call gives the same bits as ever, on
    whatever memory the failed one left behind.
    """
    expected = run()
    for number in itertools.count(1):
        native.delete_unused_frames()
        native.fail_allocation(number)
        error = None
        try:
            run()
        except MemoryError as raised:
            error = raised
        reached = native.allocation_failed()
        native.fail_allocation(0)
        assert (error is not None) == reached, f"allocation {number}"
        again = run()
        assert len(again) == len(expected)
        assert all(torch.equal(a, b) for a, b in zip(again, expected, strict=True)), number
        if not reached:
            break
    assert number > at_least


@pytest.fixture
def view() -> tuple[Any, Results]:
    """A small scene, and behind it enough opaque Gaussians for a second segment of tile lists.

    A segment holds some 65,000 pairs: 700 Gaussians in each of 100 tiles are more.
    """
    camera = make_camera(160, 160, focal=150.0)
    scene = make_scene(100, camera, dtype=torch.float32)
    wall = make_scene(700, camera, dtype=torch.float32)
    wall["means"][:] = torch.tensor([0.0, 0.0, 500.0])
    wall["scales"][:] = 2000.0
    wall["opacities"][:] = 0.99
    config = render_config(camera, RasterSettings(), 3, CullingOptions())
    return config, [torch.cat([scene[name], wall[name]]) for name in PARAMETERS]


def test_forward_and_visible(view: tuple[Any, Results]) -> None:
    config, parameters = view

    def run() -> Results:
        frame = native.Frame()
        image, alpha = frame.forward(config, *parameters, None, THREADS)
        assert frame.pair_count > 70_000
        return [image, alpha, frame.visible()]

    assert_every_failure_is_an_error(run, at_least=20)


def test_backward(view: tuple[Any, Results]) -> None:
    config, parameters = view
    offset = torch.zeros(len(parameters[0]), 2)
    v_image = torch.linspace(-1, 1, 160 * 160 * 3).reshape(160, 160, 3)
    frame = native.Frame()
    _, alpha = frame.forward(config, *parameters, offset, THREADS)

    def run() -> Results:
        *gradients, finite = frame.backward(
            v_image, torch.ones_like(alpha), *parameters, offset, True, THREADS
        )
        assert finite
        return list(gradients)

    assert_every_failure_is_an_error(run, at_least=8)


def test_a_frame_is_used_again_after_a_failure(view: tuple[Any, Results]) -> None:
    config, parameters = view
    frame, other = native.Frame(), native.Frame()
    expected = other.forward(config, *parameters, None, THREADS)
    v_image, v_alpha = torch.ones(160, 160, 3), torch.ones(160, 160)
    for number in itertools.count(1):
        native.delete_unused_frames()
        native.fail_allocation(number)
        with contextlib.suppress(MemoryError):
            frame.forward(config, *parameters, None, THREADS)
        reached = native.allocation_failed()
        native.fail_allocation(0)
        if not reached:
            break
        with pytest.raises(ValueError, match="the frame has no render"):
            frame.backward(v_image, v_alpha, *parameters, None, True, THREADS)
        with pytest.raises(ValueError, match="the frame has no render"):
            frame.visible()
        image, alpha = frame.forward(config, *parameters, None, THREADS)
        assert torch.equal(image, expected[0])
        assert torch.equal(alpha, expected[1])
        frame = native.Frame()  # the next failure, from the start
    assert number > 5


@pytest.mark.parametrize("weighted", [False, True])
def test_loss(weighted: bool) -> None:
    g = torch.Generator().manual_seed(0)
    image, target = torch.rand(2, 80, 48, 3, generator=g)
    mean, variance = torch.rand(2, 70, 38, 3, generator=g)
    weight = torch.rand(80, 48, generator=g) if weighted else None

    def run() -> Results:
        value, gradient = native.photometric_loss(
            image, target, mean, variance, weight, 0.8, 0.2, True, THREADS
        )
        return [torch.tensor(value, dtype=torch.float64), gradient]

    assert_every_failure_is_an_error(run, at_least=4)


@pytest.mark.parametrize("name", ["exp", "logistic"])
def test_activations(name: str) -> None:
    x = torch.linspace(-5, 5, 40_000)

    def run() -> Results:
        y = getattr(native, name)(x, THREADS)
        return [y, getattr(native, f"{name}_backward")(x, y, THREADS)]

    assert_every_failure_is_an_error(run, at_least=4)


def test_adam() -> None:
    start = torch.linspace(-1, 1, 40_000)

    def run() -> Results:
        tensors = [start.clone(), start.clone(), torch.zeros(40_000), torch.zeros(40_000)]
        before = [tensor.clone() for tensor in tensors]
        try:
            native.adam_step([(*tensors, 0.1, 1.0)], 0.9, 0.999, 1e-15, THREADS)
        except MemoryError:
            assert all(torch.equal(a, b) for a, b in zip(tensors, before, strict=True))
            raise
        return tensors

    assert_every_failure_is_an_error(run, at_least=2)


def test_adam_of_harmonics() -> None:
    g = torch.Generator().manual_seed(0)
    start, means, gradient = (
        torch.randn(2000, *shape, generator=g) for shape in ((15, 3), (3,), (1, 3))
    )

    def run() -> Results:
        tensors = [start.clone(), torch.zeros_like(start), torch.zeros_like(start)]
        harmonics = (*tensors, means, gradient, [0.0, 0.0, -9.0], 3, 0.1, 1.0)
        native.adam_step([], 0.9, 0.999, 1e-15, THREADS, harmonics)
        return tensors

    assert_every_failure_is_an_error(run, at_least=0)


def test_densification_statistics() -> None:
    gradient, visible = torch.ones(40_000, 2), torch.ones(40_000, dtype=torch.bool)

    def run() -> Results:
        sums = [torch.zeros(40_000), torch.zeros(40_000)]
        native.accumulate_grad2d(gradient, visible, 1.0, 1.0, *sums, THREADS)
        return sums

    assert_every_failure_is_an_error(run, at_least=0)


@pytest.mark.parametrize("size", [(20, 30), (90, 70)])
def test_resample(size: tuple[int, int]) -> None:
    image = torch.rand(50, 40, 3, generator=torch.Generator().manual_seed(0))
    matrices = *banded_matrix(50, size[0]), *banded_matrix(40, size[1])
    assert_every_failure_is_an_error(
        lambda: [native.resample(image, *matrices, THREADS)], at_least=3
    )


def test_plane_sweep() -> None:
    image = np.random.default_rng(0).random((20, 30)).astype(np.float32)
    padded = np.pad(image, ((0, 1), (0, 1)), mode="edge")
    directions = np.stack([image, image, np.ones_like(image)])
    shift, depths = np.ones(3, np.float32), np.ones((2, 1, 1), np.float32)
    other = ([directions], [shift], [padded], [np.empty((0, 0), bool)])

    def run() -> Results:
        costs, sums = (np.empty((2, 20, 30), np.float32) for _ in range(2))
        native.plane_sweep_costs([image] * 4, *other, depths, 1, 1e-5, 1e-6, costs)
        native.semiglobal_sums(costs, 0.2, 0.015, sums)
        return [torch.from_numpy(costs), torch.from_numpy(sums)]

    assert_every_failure_is_an_error(run, at_least=3)


FEWER_THREADS = """
import torch
from xrgs import _native

gradient, visible = torch.ones(100_000, 2), torch.ones(100_000, dtype=torch.bool)
for failing in (1, 0):  # the allocation that starts the second thread, then none
    sums = torch.zeros(100_000), torch.zeros(100_000)
    _native.fail_allocation(failing)
    _native.accumulate_grad2d(gradient, visible, 3.0, 4.0, *sums, 2)
    assert _native.allocation_failed() == bool(failing)
    assert (sums[0] == 5).all() and (sums[1] == 1).all()
print("done")
"""


def test_a_thread_that_cannot_start_is_done_without() -> None:
    result = subprocess.run(  # where the pool has no thread yet
        [sys.executable, "-c", FEWER_THREADS], capture_output=True, text=True, check=False
    )
    assert result.stdout == "done\n", result.stderr
