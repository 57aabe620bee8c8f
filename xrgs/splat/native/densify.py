"""The densification statistics of a step by the compiled kernel, in one pass over memory."""

from __future__ import annotations

import torch
from torch import Tensor

from xrgs import _native
from xrgs.splat.native.arguments import handle, require_contiguous, require_float32


def accumulate_statistics(
    means2d_grad: Tensor,
    visible: Tensor,
    half_size: tuple[float, float],
    grad2d_sum: Tensor,
    visible_count: Tensor,
) -> None:
    """Add a step's image-plane gradients as `xrgs.splat.torch.densify.accumulate_statistics` does.

    Raises:
        ValueError: A tensor has the wrong type, shape or strides.
    """
    require_float32("means2d_grad", means2d_grad)
    if visible.dtype != torch.bool:
        raise ValueError(f"visible must be bool, got {visible.dtype}")
    require_contiguous("grad2d_sum", grad2d_sum)
    require_contiguous("visible_count", visible_count)
    _native.accumulate_grad2d(
        handle(means2d_grad.contiguous()),
        handle(visible.contiguous()),
        *half_size,
        handle(grad2d_sum),
        handle(visible_count),
        torch.get_num_threads(),
    )
    # The kernel writes in place: autograd must refuse the old values.
    torch.autograd.graph.increment_version(grad2d_sum)
    torch.autograd.graph.increment_version(visible_count)
