"""Antialiased bicubic resampling along one axis, as a matrix."""

from __future__ import annotations

from functools import cache

import torch
from torch import Tensor
from torch.nn.functional import interpolate


@cache
def bicubic_matrix(old: int, new: int) -> Tensor:
    """Return the weights of torch's `interpolate(mode="bicubic", antialias=True)` along one axis.

    Resampling is linear, so the weights are the interpolated identity matrix. Each row sums to 1.

    Returns:
        [new, old] float64 for numbers of samples before and after resampling. The matrix is cached:
        callers must not write to it.
    """
    identity = torch.eye(old, dtype=torch.float64)[None, None]  # [1, 1, old, old]
    return interpolate(identity, size=(new, old), mode="bicubic", antialias=True)[0, 0]
