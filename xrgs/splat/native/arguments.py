"""Checks of arguments for all native operations."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.utils.dlpack import to_dlpack  # type: ignore[attr-defined]

#: Makes the DLPack capsule of a tensor, which the kernels take in its place. Given a tensor, they
#: would call `Tensor.__dlpack__`, which is written in Python and takes ten times as long.
handle = to_dlpack


def require_float32(name: str, value: Tensor) -> None:
    """Raise ValueError, naming the tensor, unless it is float32 on the CPU."""
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
