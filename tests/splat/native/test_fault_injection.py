"""Every allocation of the compiled module made to fail in turn: an error, and no harm done.

Only a build with fault injection can do this; `tests/csrc/sanitize.sh` makes one and runs this.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from tests.runtime.programs import run_python
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


def random(*shapes: tuple[int, ...]) -> Iterator[Tensor]:
    generator = torch.Generator().manual_seed(0)
    return (torch.rand(shape, generator=generator) for shape in shapes)


def loss(*, weighted: bool) -> Results:
    image, target, mean, variance, weight = random(*[(80, 48, 3)] * 2, *[(70, 38, 3)] * 2, (80, 48))
    value, gradient = native.photometric_loss(
        image, target, mean, variance, weight if weighted else None, 0.8, 0.2, True, THREADS
    )
    return [torch.tensor(value, dtype=torch.float64), gradient]


def activation(name: str) -> Results:
    x = torch.linspace(-5, 5, 40_000)
    y = getattr(native, name)(x, THREADS)
    return [y, getattr(native, f"{name}_backward")(x, y, THREADS)]


def adam() -> Results:
    tensors = [*random(*[(40_000,)] * 2), *torch.zeros(2, 40_000)]
    before = [tensor.clone() for tensor in tensors]
    try:
        native.adam_step([(*tensors, 0.1, 1.0)], 0.9, 0.999, 1e-15, THREADS)
    except MemoryError:
        assert all(torch.equal(a, b) for a, b in zip(tensors, before, strict=True))
        raise
    return tensors


def adam_of_harmonics() -> Results:
    start, means, gradient = random((2000, 15, 3), (2000, 3), (2000, 1, 3))
    tensors = [start, torch.zeros_like(start), torch.zeros_like(start)]
    harmonics = (*tensors, means, gradient, [0.0, 0.0, -9.0], 3, 0.1, 1.0)
    native.adam_step([], 0.9, 0.999, 1e-15, THREADS, harmonics)
    return tensors


def statistics() -> Results:
    gradient, visible = torch.ones(40_000, 2), torch.ones(40_000, dtype=torch.bool)
    sums = [torch.zeros(40_000), torch.zeros(40_000)]
    native.accumulate_grad2d(gradient, visible, 1.0, 1.0, *sums, THREADS)
    return sums


def resample(height: int, width: int) -> Results:
    matrices = *banded_matrix(50, height), *banded_matrix(40, width)
    return [native.resample(*random((50, 40, 3)), *matrices, THREADS)]


def plane_sweep() -> Results:
    image = np.random.default_rng(0).random((20, 30)).astype(np.float32)
    padded = np.pad(image, ((0, 1), (0, 1)), mode="edge")
    directions = np.stack([image, image, np.ones_like(image)])
    shift, depths = np.ones(3, np.float32), np.ones((2, 1, 1), np.float32)
    other = ([directions], [shift], [padded], [np.empty((0, 0), bool)])
    costs, sums = (np.empty((2, 20, 30), np.float32) for _ in range(2))
    native.plane_sweep_costs([image] * 4, *other, depths, 1, 1e-5, 1e-6, costs)
    native.semiglobal_sums(costs, 0.2, 0.015, sums)
    return [torch.from_numpy(costs), torch.from_numpy(sums)]


@pytest.mark.parametrize(
    ("run", "at_least"),
    [
        (partial(loss, weighted=False), 4),
        (partial(loss, weighted=True), 4),
        (partial(activation, "exp"), 4),
        (partial(activation, "logistic"), 4),
        (adam, 2),
        (adam_of_harmonics, 0),
        (statistics, 0),
        (partial(resample, 20, 30), 3),
        (partial(resample, 90, 70), 3),
        (plane_sweep, 3),
    ],
)
def test_other_kernels(run: Callable[[], Results], at_least: int) -> None:
    assert_every_failure_is_an_error(run, at_least)


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
    result = run_python(FEWER_THREADS)  # where the pool has no thread yet
    assert result.stdout == "done\n", result.stderr
