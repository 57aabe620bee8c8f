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
    """Add the image-plane gradients of a step to the sums that densification decides by.

    Args:
        means2d_grad: [N, 2] float32 gradient of the loss by the projected means, per px.
        visible: [N] bool; Gaussians that are not visible add nothing, whatever their gradient.
        half_size: Half the view's width and height, px: the factors to normalised device units.
        grad2d_sum: [N] float32 to which the gradients' norms are added in place.
        visible_count: [N] float32 to which 1 is added in place where visible.

    Raises:
        ValueError: A tensor has another type or shape, or a sum is not contiguous.
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
    # So that autograd refuses to use the values from before.
    torch.autograd.graph.increment_version(grad2d_sum)
    torch.autograd.graph.increment_version(visible_count)
