"""The functions that the kernels have of their own, against float64, on every instruction set."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch

native = pytest.importorskip("xrgs._native")

Floats = np.ndarray[Any, np.dtype[np.float32]]

EXP2_ERROR = {"portable": 1.1e-7}
EXP2_ERROR_ELSE = 8.2e-8
LOG2_ERROR = {"portable": 2.4e-7}
LOG2_ERROR_ELSE = 2.1e-7
"""Relative errors, as simd.h states them: those of the portable kernels where these round a product
and a sum one after the other, which a processor with a fused multiply-add need not do."""


def between(low: float, high: float, every: int = 1) -> Floats:
    """Every so manieth of the float32 numbers from `low` to `high`, both above 0."""
    first, last = (int(np.float32(bound).view(np.int32)) for bound in (low, high))
    return np.arange(first, last, every, dtype=np.int32).view(np.float32)


def relative_error(
    name: str, reference: Callable[[Any], Any], x: Floats
) -> np.ndarray[Any, np.dtype[np.float64]]:
    exact = reference(x.astype(np.float64))
    got = getattr(native, name)(torch.from_numpy(x)).numpy().astype(np.float64)
    relative: np.ndarray[Any, np.dtype[np.float64]] = got / exact - 1
    return relative


def test_exp2(isa: str) -> None:
    # All that matters is the distance to the nearest integer, and how coarse x is.
    fractions = between(2.0**-20, 0.5, every=101)
    wide = np.linspace(-126, 127, 200_001).astype(np.float32)
    for x in (fractions, -fractions, fractions + np.float32(3), fractions - np.float32(8), wide):
        error = np.abs(relative_error("exp2", np.exp2, x))
        assert error.max() <= EXP2_ERROR.get(isa, EXP2_ERROR_ELSE)
    integers = np.arange(-126, 128, dtype=np.float32)
    assert (relative_error("exp2", np.exp2, integers) == 0).all()


def test_log2(isa: str) -> None:
    mantissas = between(0.5, 4.0, every=101)
    mantissas = mantissas[mantissas != 1]
    # Next to 1 the logarithm is next to 0, and still relatively exact.
    next_to_1 = np.concatenate([between(0.9999, 1.0), between(1.0001, 1.001)])
    wide = np.exp2(np.linspace(-126, 126.9, 200_001)).astype(np.float32)
    for x in (mantissas, next_to_1, wide[wide != 1]):
        error = np.abs(relative_error("log2", np.log2, x))
        assert error.max() <= LOG2_ERROR.get(isa, LOG2_ERROR_ELSE)
    exponents = np.arange(-126, 128, dtype=np.float32)
    powers = torch.from_numpy(np.exp2(exponents))
    assert np.array_equal(native.log2(powers).numpy(), exponents)


def test_sqrt_upper_bound(isa: str) -> None:
    mantissas = between(0.25, 4.0, every=101)
    wide = np.exp2(np.linspace(-66, 127.9, 200_001)).astype(np.float32)
    wide = wide[wide >= 1e-20]
    for x in (mantissas, wide):
        excess = relative_error("sqrt_upper_bound", np.sqrt, x)
        assert excess.min() >= 0
        assert excess.max() <= 2e-3
    small = torch.tensor([0.0, 1e-45, 1e-30, 1e-20])
    bound = native.sqrt_upper_bound(small)
    assert (bound >= 1e-10).all()
    assert (bound <= 1.002e-10).all()
