"""How the compiled module takes and returns tensors, whatever it computes."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor

from tests.splat.scenes import (
    SHAPES,
    make_camera,
    make_optimizer,
    normal_parameters,
    take_step,
)
from xrgs.splat.native.rasterizer import render_config
from xrgs.splat.native.resample import banded_matrix
from xrgs.splat.settings import CullingOptions, RasterSettings

native = pytest.importorskip("xrgs._native")

N = 20


def strided(tensor: Tensor) -> Tensor:
    """The same values, not side by side."""
    return tensor.repeat_interleave(2, dim=-1)[..., ::2]


def ones(*shapes: tuple[int, ...]) -> list[Tensor]:
    return [torch.ones(shape) for shape in shapes]


PARAMETER_SHAPES = [(N, *shape) for shape in (*SHAPES.values(), (2,))]


def forward(*parameters: Tensor) -> Any:
    frame = native.Frame()
    config = render_config(make_camera(20, 20), RasterSettings(), 3, CullingOptions())
    frame.forward(config, *parameters, 1)
    return frame


def backward(*tensors: Tensor) -> None:
    forward(*ones(*PARAMETER_SHAPES)).backward(*tensors, True, 1)


ADAM = (0.9, 0.999, 1e-15, 1)
CALLS: dict[str, tuple[Callable[..., object], list[Tensor]]] = {
    "adam_step": (lambda *t: native.adam_step([(*t, 0.1, 1.0)], *ADAM), ones(*[(N,)] * 4)),
    "adam_step of harmonics": (
        lambda *t: native.adam_step([], *ADAM, (*t, [0.0, 0.0, 9.0], 3, 0.1, 1.0)),
        ones(*[(N, 15, 3)] * 3, (N, 3), (N, 1, 3)),
    ),
    "accumulate_grad2d": (
        lambda gradient, visible, *t: native.accumulate_grad2d(gradient, visible, 1.0, 1.0, *t, 1),
        [*ones((N, 2)), torch.ones(N).bool(), *ones((N,), (N,))],
    ),
    "forward": (forward, ones(*PARAMETER_SHAPES)),
    "backward": (backward, ones((20, 20, 3), (20, 20), *PARAMETER_SHAPES)),
    "photometric_loss": (
        lambda *t: native.photometric_loss(*t, 0.8, 0.2, True, 1),
        ones(*[(20, 20, 3)] * 2, *[(10, 10, 3)] * 2, (20, 20)),
    ),
    "resample": (
        lambda *t: native.resample(*t, 1),
        [*ones((20, 20, 3)), *banded_matrix(20, 9), *banded_matrix(20, 9)],
    ),
    "exp": (lambda x: native.exp(x, 1), ones((N,))),
}


@pytest.mark.parametrize("name", CALLS)
def test_nothing_is_converted(name: str) -> None:
    call, tensors = CALLS[name]
    call(*(tensor.clone() for tensor in tensors))
    for place, tensor in enumerate(tensors):
        for wrong in (tensor.double(), strided(tensor)):
            changed = [*tensors[:place], wrong, *tensors[place + 1 :]]
            with pytest.raises(TypeError, match=r"incompatible function arguments|must be float32"):
                call(*changed)


# --- autograd notices changes in place -----------------------------------------------------------


@pytest.mark.parametrize("with_camera", [False, True])
@pytest.mark.parametrize("name", ["means", "shN"])
def test_a_backward_pass_through_values_from_before_a_step_is_refused(
    with_camera: bool, name: str
) -> None:
    # As it is with torch.optim.Adam and its defaults.
    of = make_optimizer(normal_parameters(N, 0), backend="native")
    saved = of.gaussians[name].square().sum()  # keeps the values for its gradient
    gradients = normal_parameters(N, 1)
    if with_camera:
        del gradients["shN"]
    take_step(of, gradients, make_camera() if with_camera else None, 3)
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        torch.autograd.backward(saved)


# --- memory that is used again -------------------------------------------------------------------


@pytest.fixture
def reuse() -> None:
    """Skip the test where released memory is not kept, as under AddressSanitizer."""
    native.exp2(torch.ones(100_000))
    if native.unused_bytes() == 0:
        pytest.skip("this build keeps no released memory")


@pytest.mark.usefixtures("reuse")
def test_memory_of_sizes_that_are_no_longer_wanted_is_freed() -> None:
    count = 100_000
    for _ in range(12):  # each size for a while, as a model grows
        count = count * 9 // 8
        x = torch.ones(count)
        assert len({native.exp2(x).data_ptr() for _ in range(3)}) == 1
        for _ in range(300):
            native.exp2(x[:1])
    # What was in use last, up to an eighth more of it, and the size before.
    assert native.unused_bytes() < 2.2 * 4 * count


@pytest.mark.usefixtures("reuse")
def test_memory_of_sizes_that_take_turns_is_kept() -> None:
    sizes = [50_000, 80_000, 120_000, 200_000]
    inputs = [torch.ones(size) for size in sizes]
    first = [native.exp2(x).data_ptr() for x in inputs]
    for _ in range(100):
        assert [native.exp2(x).data_ptr() for x in inputs] == first
    assert native.unused_bytes() >= 4 * sum(sizes)
    native.exp2(torch.ones(300_000))  # of another size: those that take turns stay
    assert [native.exp2(x).data_ptr() for x in inputs] == first
