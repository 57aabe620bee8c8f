"""The instruction sets, backends and threads that the tests of the model run on."""

from __future__ import annotations

import importlib.util
from collections.abc import Iterator
from typing import Any

import pytest
import torch

from xrgs.splat.cameras import Camera


@pytest.fixture
def pixel() -> Camera:
    """The camera whose only pixel's centre is the optical axis."""
    K = torch.tensor([[10.0, 0, 0.5], [0, 10, 0.5], [0, 0, 1]], dtype=torch.float64)
    return Camera(torch.eye(4, dtype=torch.float64), K, 1, 1)


def _isas() -> list[Any]:
    """The chosen instruction set, and the one without a fused multiply-add.

    All others give the bits of the first (`native/test_same_bits.py`).
    """
    if importlib.util.find_spec("xrgs._native") is None:
        return []
    from xrgs import _native

    chosen = _native.isa()
    return [
        chosen,
        *([] if chosen == "portable" else [pytest.param("portable", marks=pytest.mark.slow)]),
    ]


@pytest.fixture(params=_isas())
def isa(request: pytest.FixtureRequest) -> Iterator[str]:
    """The instruction sets that round differently."""
    from xrgs import _native

    before = _native.isa()
    _native.set_isa(request.param)
    yield request.param
    _native.set_isa(before)


@pytest.fixture
def threads() -> Iterator[None]:
    """Restore torch's number of threads after the test."""
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


@pytest.fixture(params=["torch", "native"])
def backend(request: pytest.FixtureRequest) -> str:
    """The backends on the CPU."""
    if request.param == "native":
        pytest.importorskip("xrgs._native")
    name: str = request.param
    return name
