"""The compiled resampling against the torch one, and its gradient against its transpose."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from tests.splat.scenes import noise
from xrgs.splat.resample import resize

native = pytest.importorskip("xrgs._native")

side = st.integers(1, 70)


def value_and_gradient(image: Tensor, slope: Tensor) -> tuple[Tensor, Tensor]:
    leaf = image.clone().requires_grad_()
    resized = resize(leaf, slope.shape[0], slope.shape[1], backend="native")
    (gradient,) = torch.autograd.grad(resized, leaf, slope)
    return resized.detach(), gradient


@settings(max_examples=60)
@given(old=st.tuples(side, side), new=st.tuples(side, side), seed=st.integers(0, 10**6))
def test_the_gradient_is_by_the_transpose(
    old: tuple[int, int], new: tuple[int, int], seed: int
) -> None:
    image, slope = noise(*old, seed).float(), noise(*new, seed + 1).float() - 0.5
    resized, gradient = value_and_gradient(image, slope)
    torch.testing.assert_close(
        resized.double(), resize(image.double(), *new), rtol=0, atol=1e-6 * 3
    )
    # <phi x, y> = <x, phi^T y>, and by how much the terms of the two sums may be off.
    forth = (resized.double() * slope.double()).sum().item()
    back = (image.double() * gradient.double()).sum().item()
    terms = (resized.double() * slope.double()).abs().sum().item()
    terms += (image.double() * gradient.double()).abs().sum().item()
    assert abs(forth - back) <= 1e-6 * terms


def test_what_does_not_fit_is_refused() -> None:
    with pytest.raises(ValueError, match=r"image must be float32 on the CPU.*float64"):
        resize(noise(4, 5), 8, 10, backend="native")
    image, one = torch.zeros(4, 5, 3), torch.ones(2, 2)
    inside = torch.tensor([0, 2], dtype=torch.int32)
    for first in ([0, 4], [-1, 0]):
        outside = torch.tensor(first, dtype=torch.int32)
        with pytest.raises(ValueError, match="a band reaches out of the image"):
            native.resample(image, outside, one, inside, one, 1)
    with pytest.raises(ValueError, match="weights that do not fit"):
        native.resample(image, inside, torch.ones(3, 2), inside, one, 1)
