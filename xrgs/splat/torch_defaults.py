"""The defaults of torch, which the program around us may have changed."""

from __future__ import annotations

from functools import wraps
from typing import TYPE_CHECKING, ParamSpec, TypeVar

import torch

if TYPE_CHECKING:
    from collections.abc import Callable

_P = ParamSpec("_P")
_R = TypeVar("_R")


def on_cpu_in_float32(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """Run a function with torch's own default type and device, float32 and the CPU.

    Those of the caller, of `torch.set_default_dtype` and `torch.set_default_device`, are restored
    afterwards. Meanwhile other threads of the process have torch's own type, too.
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
