"""The checks of arguments that the native operations have in common."""

from __future__ import annotations

import torch
from torch import Tensor


def require_float32(name: str, value: Tensor) -> None:
    """Raise ValueError unless a tensor, named in the message, is float32 on the CPU."""
    if value.dtype != torch.float32 or value.device.type != "cpu":
        raise ValueError(
            f"{name} must be float32 on the CPU for the native backend, got {value.dtype} on"
            f" {value.device}"
        )


def require_contiguous(name: str, value: Tensor) -> None:
    """Raise ValueError unless a tensor that a kernel changes in place is float32 and contiguous."""
    require_float32(name, value)
    if not value.is_contiguous():
        raise ValueError(
            f"{name} must be contiguous for the native backend, got strides {value.stride()}"
        )
