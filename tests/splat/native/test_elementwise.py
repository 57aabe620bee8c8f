"""The compiled activations against numpy and torch in double, and the densification statistics."""

from __future__ import annotations

import importlib
from collections.abc import Callable

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor

from tests.splat.scenes import make_strategy, normal_parameters
from xrgs.splat.strategy.default import DefaultStrategy

native = pytest.importorskip("xrgs._native")
elementwise = importlib.import_module("xrgs.splat.native.elementwise")

SMALLEST = 2.0**-126
"""The smallest normal float32 number."""
LARGEST = float(np.finfo(np.float32).max)
FUNCTIONS = {"exp": elementwise.exp, "logistic": elementwise.logistic}
EXACT: dict[str, Callable[[NDArray[np.float64]], NDArray[np.float64]]] = {
    "exp": np.exp,
    "logistic": lambda x: np.exp(np.minimum(x, 0)) / (1 + np.exp(-np.abs(x))),
}
ERROR = {"exp": 1.0e-7, "logistic": 2.0e-7}
ENDS = {"exp": [0, 1, 1, np.inf], "logistic": [0, 0.5, 0.5, 1]}
"""Values at -inf, -0, 0 and inf."""


def floats_around(value: float) -> NDArray[np.float32]:
    """The 300 floats that are next to a value, on each side."""
    bits = int(np.float32(value).view(np.int32))
    return np.arange(bits - 300, bits + 300, dtype=np.int32).view(np.float32)


def every_magnitude() -> NDArray[np.float32]:
    """Arguments of all sizes, and the floats next to each bound of the functions' ranges."""
    rng = np.random.default_rng(0)
    sizes = 10.0 ** rng.uniform(-30, 2, size=20_000) * rng.choice([-1, 1], size=20_000)
    bounds = [floats_around(sign * np.log(v)) for v in (LARGEST, SMALLEST) for sign in (-1, 1)]
    return np.concatenate([np.linspace(-104, 104, 100_003), sizes, *bounds]).astype(np.float32)


@pytest.mark.parametrize("name", FUNCTIONS)
def test_values_are_those_in_double(isa: str, name: str) -> None:
    x = every_magnitude()
    y = FUNCTIONS[name](torch.from_numpy(x)).numpy().astype(np.float64)
    with np.errstate(over="ignore"):
        exact = EXACT[name](x.astype(np.float64))
    normal = (exact >= SMALLEST) & (exact <= LARGEST)
    assert np.abs(y[normal] / exact[normal] - 1).max() < ERROR[name]
    assert (y[exact < SMALLEST] == 0).all()
    assert (y[exact > LARGEST] == np.inf).all()
    assert (exact < SMALLEST).any()
    assert (exact > LARGEST).any() == (name == "exp")
    ends = FUNCTIONS[name](torch.tensor([-torch.inf, -0.0, 0.0, torch.inf, torch.nan]))
    assert ends[:4].tolist() == ENDS[name]
    assert ends[4].isnan()


@pytest.mark.parametrize("name", FUNCTIONS)
@pytest.mark.parametrize("count", [0, 5, 16, 40_000])
def test_gradients_are_those_in_double(name: str, count: int) -> None:
    generator = torch.Generator().manual_seed(count)
    x = 4 * torch.randn(count, 3, generator=generator)
    slope = torch.randn(count, 3, generator=generator)
    ours, exact = x.requires_grad_(), x.detach().double().requires_grad_()
    torch.autograd.backward(FUNCTIONS[name](ours), slope)
    reference = {"exp": torch.exp, "logistic": torch.sigmoid}[name](exact)
    torch.autograd.backward(reference, slope.double())
    assert ours.grad is not None
    assert exact.grad is not None
    # 1 - y of the logistic function loses the digits that y itself has lost.
    relative, absolute = (3e-7, 0.0) if name == "exp" else (5e-7, 3e-7)
    torch.testing.assert_close(ours.grad.double(), exact.grad, rtol=relative, atol=absolute)


@pytest.mark.parametrize("name", FUNCTIONS)
def test_other_strides_are_taken_and_other_types_and_lengths_refused(name: str) -> None:
    x = torch.linspace(-3, 3, 30).view(5, 6)
    assert torch.equal(FUNCTIONS[name](x.T), FUNCTIONS[name](x).T)
    with pytest.raises(ValueError, match=r"(scales|opacities) must be float32 on the CPU"):
        FUNCTIONS[name](x.double())
    with pytest.raises(ValueError, match="shapes that do not fit"):
        getattr(native, f"{name}_backward")(torch.zeros(3), torch.zeros(4), 1)


def step(count: int, seed: int = 0) -> tuple[Tensor, Tensor]:
    """Image-plane gradients [N, 2] and visibility [N]."""
    generator = torch.Generator().manual_seed(seed)
    gradient = 1e-4 * torch.randn(count, 2, generator=generator)
    return gradient, torch.rand(count, generator=generator) < 0.6


def strategy(count: int, backend: str, dtype: torch.dtype = torch.float32) -> DefaultStrategy:
    return make_strategy(normal_parameters(count, 1, dtype=dtype), backend=backend)


@pytest.mark.parametrize("count", [0, 1, 16, 31, 40_000])
def test_sums_are_those_in_double(isa: str, count: int) -> None:
    ours, exact = strategy(count, "native"), strategy(count, "torch", torch.float64)
    for number in range(3):
        gradient, visible = step(count, number)
        width = 100 + number
        ours.after_step(number, gradient, visible, width=width, height=75)
        exact.after_step(number, gradient.double(), visible, width=width, height=75)
    assert torch.equal(ours.visible_count.double(), exact.visible_count)
    torch.testing.assert_close(ours.grad2d_sum.double(), exact.grad2d_sum, rtol=4e-7, atol=0)


def test_what_is_not_visible_adds_nothing(backend: str) -> None:
    gradient, visible = step(50)
    gradient[~visible] = torch.nan
    ours = strategy(50, backend)
    ours.after_step(1, gradient, visible, width=9, height=9)
    assert ours.grad2d_sum.isfinite().all()
    assert not ours.grad2d_sum[:, ~visible].any()
    assert torch.equal(ours.visible_count[0], visible.float())


def test_shapes_that_do_not_fit_are_refused() -> None:
    good = [*step(20), torch.zeros(20), torch.zeros(20)]
    for place in range(4):
        slope, visible, total, seen = (t[: 19 if i == place else 20] for i, t in enumerate(good))
        with pytest.raises(ValueError, match="shapes that do not fit"):
            native.accumulate_grad2d(slope, visible, 1.0, 1.0, total, seen, 1)
