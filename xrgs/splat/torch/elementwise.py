"""The activation functions and the densification statistics in plain torch."""

from __future__ import annotations

import torch
from torch import Tensor

from xrgs.splat.gaussians import ActivatedGaussians


def exp(x: Tensor) -> Tensor:
    """Return e^x: scales from their natural logarithms."""
    return torch.exp(x)


def logistic(x: Tensor) -> Tensor:
    """Return 1 / (1 + e^-x): opacities from their logits."""
    return torch.sigmoid(x)


def activated(raw: ActivatedGaussians) -> ActivatedGaussians:
    """Apply the activation functions to raw Gaussians (log scales, logit opacities)."""
    return raw._replace(scales=exp(raw.scales), opacities=logistic(raw.opacities))


def accumulate_statistics(
    means2d_grad: Tensor,
    visible: Tensor,
    half_size: tuple[float, float],
    grad2d_sum: Tensor,
    visible_count: Tensor,
) -> None:
    """Add a step's image-plane gradients to the statistics for densification, in place.

    gsplat's `DefaultStrategy._update_state` (`strategy/default.py`).

    Args:
        means2d_grad: [N, 2] gradient of the loss with respect to the projected means, per px.
        visible: [N] bool; gradients of Gaussians that are not visible are ignored.
        half_size: Half the view's width and height, px: the factors to normalised device units.
        grad2d_sum: [N] sum of the norms of the gradients, which is increased.
        visible_count: [N] number of views that showed the Gaussian, which is increased.
    """
    scaled = means2d_grad * means2d_grad.new_tensor(half_size)  # [N, 2]
    grad2d_sum += torch.where(visible, scaled.norm(dim=-1), 0)
    visible_count += visible
