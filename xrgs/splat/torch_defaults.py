"""Independence from torch's default dtype and device, which a user's program may have changed."""

from __future__ import annotations

from functools import wraps
from typing import TYPE_CHECKING, ParamSpec, TypeVar

import torch

if TYPE_CHECKING:
    from collections.abc import Callable

_P = ParamSpec("_P")
_R = TypeVar("_R")


def on_cpu_in_float32(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """Decorate a function to run with torch's defaults, float32 and the CPU.

    The caller's settings (`torch.set_default_dtype`, `torch.set_default_device`) are restored
    afterwards. Meanwhile float32 is the default in other threads of the process too.
    """

    @wraps(function)
    def run(*args: _P.args, **kwargs: _P.kwargs) -> _R:
        dtype, device = torch.get_default_dtype(), torch.get_default_device()
        if dtype == torch.float32 and device.type == "cpu":
            return function(*args, **kwargs)
        torch.set_default_dtype(torch.float32)
        try:
            with torch.device("cpu"):
                return function(*args, **kwargs)
        finally:
            torch.set_default_dtype(dtype)

    return run
