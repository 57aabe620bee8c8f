"""Densification's bookkeeping of a step by the compiled kernel."""

from __future__ import annotations

import torch
from torch import Tensor

from xrgs import _native


def observe(
    means2d_grad: Tensor,
    visible: Tensor,
    units: tuple[float, float],
    gradient: Tensor,
    seen: Tensor,
) -> None:
    """Add a step's gradients to the sums that densification reads, in one pass over memory.

    Args:
        means2d_grad: [N, 2] float32.
        visible: [N] bool; the others add nothing, whatever their gradient.
        units: What the gradient along x and y is multiplied by.
        gradient: [N] float32, to which the norms are added in place.
        seen: [N] float32, to which 1 is added in place.
    """
    _native.observe(
        means2d_grad.contiguous(), visible, *units, gradient, seen, torch.get_num_threads()
    )
