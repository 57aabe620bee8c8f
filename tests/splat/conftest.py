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
    """The instruction sets of this machine; those that are not chosen by default are slow."""
    if importlib.util.find_spec("xrgs._native") is None:
        return []
    from xrgs import _native

    chosen = _native.isa()
    return [
        pytest.param(name, marks=() if name == chosen else pytest.mark.slow)
        for name in _native.available_isas()
    ]


@pytest.fixture(params=_isas())
def isa(request: pytest.FixtureRequest) -> Iterator[str]:
    """Each instruction set that this machine has."""
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


@pytest.fixture(params=["torch", *_isas()])
def backend(request: pytest.FixtureRequest) -> Iterator[str]:
    """`torch`, and `native` on each instruction set that this machine has."""
    if request.param == "torch":
        yield "torch"
        return
    from xrgs import _native

    before = _native.isa()
    _native.set_isa(request.param)
    yield "native"
    _native.set_isa(before)
