"""Checks of arguments for all native operations."""

from __future__ import annotations

from typing import Any

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


def contiguous_handle(name: str, value: Tensor) -> Any:
    """Return `handle` of a tensor that a kernel does not copy.

    ValueError, naming the tensor, unless it is float32 on the CPU, and contiguous.
    """
    require_float32(name, value)
    if not value.is_contiguous():
        raise ValueError(
            f"{name} must be contiguous for the native backend, got strides {value.stride()}"
        )
    return handle(value)
