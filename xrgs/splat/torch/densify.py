"""The densification statistics of a step in plain torch."""

from __future__ import annotations

import torch
from torch import Tensor


def accumulate_statistics(
    means2d_grad: Tensor,
    visible: Tensor,
    half_size: tuple[float, float],
    grad2d_sum: Tensor,
    visible_count: Tensor,
) -> None:
    """Add the image-plane gradients of a step to the sums that densification decides by.

    gsplat's `DefaultStrategy._update_state` (`strategy/default.py`).

    Args:
        means2d_grad: [N, 2] gradient of the loss by the projected means, per px.
        visible: [N] bool; Gaussians that are not visible add nothing, whatever their gradient.
        half_size: Half the view's width and height, px: the factors to normalised device units.
        grad2d_sum: [N] to which the gradients' norms are added in place.
        visible_count: [N] to which 1 is added in place where visible.
    """
    scaled = means2d_grad * means2d_grad.new_tensor(half_size)  # [N, 2]
    grad2d_sum += torch.where(visible, scaled.norm(dim=-1), 0)
    visible_count += visible
