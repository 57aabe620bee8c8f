"""The compiled densification statistics against the torch ones in double."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from tests.splat.scenes import make_strategy, normal_parameters
from xrgs.splat.strategy.default import DefaultStrategy

native = pytest.importorskip("xrgs._native")


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
