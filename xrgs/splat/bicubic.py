"""The matrix of antialiased bicubic resampling along one axis."""

from __future__ import annotations

from functools import cache

import torch
from torch import Tensor
from torch.nn.functional import interpolate


@cache
def bicubic_matrix(old: int, new: int) -> Tensor:
    """Return the weights that resample one axis of an image, as torch's `interpolate` has them.

    Resampling is linear, so interpolating the columns of an identity matrix gives the weights of
    `interpolate(mode="bicubic", antialias=True)`. Each row sums to 1.

    Args:
        old: Number of samples along the axis before resampling.
        new: Number of samples after it.

    Returns:
        [new, old] float64, cached: callers must not write to it.
    """
    identity = torch.eye(old, dtype=torch.float64)[None, None]  # [1, 1, old, old]
    return interpolate(identity, size=(new, old), mode="bicubic", antialias=True)[0, 0]
