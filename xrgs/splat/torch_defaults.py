"""Independence from torch's defaults and `torch.autocast`, which a user's program may have set."""

from __future__ import annotations

from functools import wraps
from typing import TYPE_CHECKING, ParamSpec, TypeVar

import torch

if TYPE_CHECKING:
    from collections.abc import Callable

_P = ParamSpec("_P")
_R = TypeVar("_R")


def on_cpu_in_float32(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """Decorate a function to run with torch's defaults, float32 and the CPU, without autocast.

    The caller's settings (`torch.set_default_dtype`, `torch.set_default_device`) are restored
    afterwards. Meanwhile float32 is the default in other threads of the process too.
    `torch.autocast` would round the operands of matrix products to 8 or 11 bits, and so move
    projections by some px.
    """

    @wraps(function)
    def run(*args: _P.args, **kwargs: _P.kwargs) -> _R:
        dtype, device = torch.get_default_dtype(), torch.get_default_device()
        is_default = dtype == torch.float32 and device.type == "cpu"
        if is_default and not torch.is_autocast_enabled("cpu"):
            return function(*args, **kwargs)
        torch.set_default_dtype(torch.float32)
        try:
            with torch.device("cpu"), torch.autocast("cpu", enabled=False):
                return function(*args, **kwargs)
        finally:
            torch.set_default_dtype(dtype)

    return run
