"""Numbers too small for float32: no kernel slows down on them, keeps them, or leaves a trace.

The kernels take denormal numbers for zeros, whatever the state of the threads that they run on, and
leave that of the caller as it is.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
import torch
from torch import Tensor

from tests.splat.scenes import draw, make_camera, make_scene, with_gradients
from xrgs.splat.cameras import Camera

native = pytest.importorskip("xrgs._native")


BETAS = (0.9, 0.999)
SMALLEST_NORMAL = float(np.finfo(np.float32).tiny)


@pytest.fixture(autouse=True)
def denormals() -> Iterator[None]:
    """Restores torch's default after the test."""
    yield
    torch.set_flush_denormal(False)


def steps_without_gradient(
    count: int, first_moment: Tensor, threads: int, second_moment: float = 1e-24
) -> list[Tensor]:
    """Parameter and moments after `count` steps of Adam without gradient, from tiny moments."""
    exp_avg = first_moment.clone()
    exp_avg_sq, parameter = torch.full_like(exp_avg, second_moment), torch.ones_like(exp_avg)
    gradient = torch.zeros_like(exp_avg)
    for step in range(1, count + 1):
        group = (parameter, gradient, exp_avg, exp_avg_sq, 1e-3, float(step))
        native.adam_step([group], *BETAS, 1e-15, threads)
    return [parameter, exp_avg, exp_avg_sq]


def normal_or_zero(value: Tensor) -> Tensor:
    # In float64: a comparison in float32 would depend on torch's own state.
    size = value.double().abs()
    return (size == 0) | (size >= SMALLEST_NORMAL)


def test_moments_without_gradient_end_in_zeros(isa: str) -> None:
    """What becomes of the parameter, test_optimizer.py compares with float64."""
    _, exp_avg, exp_avg_sq = steps_without_gradient(3000, torch.linspace(-1e-6, 1e-6, 16), 1)
    assert normal_or_zero(exp_avg).all()
    assert normal_or_zero(exp_avg_sq).all()
    # Where a product and a sum are rounded one after the other, a moment stays when a tenth of it,
    # by which it would shrink, is denormal.
    smallest = 10 * SMALLEST_NORMAL if isa == "portable" else 0
    assert (exp_avg.double().abs() <= smallest).all()
    expected = 1e-24 * BETAS[1] ** 3000
    # beta2 is a float32, which is off by half a unit in the last place at most, as is each product.
    assert (exp_avg_sq.double() / expected - 1).abs().max() <= 3000 * 2.0**-23


@pytest.mark.usefixtures("threads")
def test_the_state_of_the_caller_changes_no_bit() -> None:
    # Through the range of denormal numbers, in several tasks.
    start = torch.logspace(-39, -35, 60_000)
    results = []
    for flush in (False, True):
        torch.set_flush_denormal(flush)
        results += [steps_without_gradient(60, start, threads, 1.2e-38) for threads in (1, 2)]
    torch.set_flush_denormal(False)
    for result in results:
        assert all(torch.equal(a, b) for a, b in zip(result, results[0], strict=True))
    _, exp_avg, exp_avg_sq = results[0]
    assert (exp_avg == 0).any()
    assert (exp_avg != 0).any()
    assert (exp_avg_sq == 0).all()


def gradients(
    scene: dict[str, Tensor], camera: Camera, v: Tensor, flush: tuple[bool, bool]
) -> list[Tensor]:
    """The gradients of a render, with torch's own state set before each of its passes."""
    leaves = with_gradients(scene)
    torch.set_flush_denormal(flush[0])
    render = draw(leaves, camera, backend="native")
    torch.set_flush_denormal(flush[1])
    found = torch.autograd.grad(render.image, list(leaves.values()), v)
    torch.set_flush_denormal(False)
    return [render.image.detach(), *found]


@pytest.mark.usefixtures("threads")
def test_a_render_does_not_depend_on_what_its_caller_flushes() -> None:
    camera = make_camera(70, 50, turned=True)
    scene = make_scene(200, camera, seed=3, dtype=torch.float32)
    v = torch.full((50, 70, 3), 1e-37)
    v[::2] = -1e-38  # many products of these and of weights are denormal
    expected = gradients(scene, camera, v, (False, False))
    assert any((gradient != 0).any() for gradient in expected[1:])
    for threads, *flush in ((1, True, True), (3, True, False), (2, False, True)):
        torch.set_num_threads(threads)
        again = gradients(scene, camera, v, (flush[0], flush[1]))
        assert all(torch.equal(a, b) for a, b in zip(again, expected, strict=True))


@pytest.mark.parametrize(("flush", "threads"), [(False, 2), (True, 1), (True, 2)])
def test_the_state_of_the_caller_is_left_as_it_is(flush: bool, threads: int) -> None:
    camera = make_camera()
    scene = make_scene(10, camera, dtype=torch.float32)
    torch.set_flush_denormal(flush)
    draw(scene, camera, backend="native")
    steps_without_gradient(2, torch.full((40_000,), 1e-38), threads)
    product = torch.full((1,), 1e-30) * torch.full((1,), 1e-12)
    torch.set_flush_denormal(False)
    assert (product.item() == 0) == flush
