"""Perceptual distance LPIPS, with AlexNet or VGG16."""

from __future__ import annotations

from typing import TYPE_CHECKING

from xrgs.evaluation.lpips import weights
from xrgs.evaluation.metrics.base import inside

if TYPE_CHECKING:
    from torch import Tensor


def lpips(image: Tensor, target: Tensor, mask: Tensor | None = None) -> float | None:
    """Compute the perceptual distance LPIPS, version 0.1, with AlexNet (`alex` in gsplat).

    Source: [zhang2018] "The unreasonable effectiveness of deep features as a perceptual
    metric"; see `xrgs.evaluation.lpips.network`. Outside the mask both images are made equal. The
    distance is the mean over the whole image. Arguments as for `psnr`.

    Returns:
        The distance, 0 for identical images; None (n/a in the tables) if this machine has no
        weights, or a side of the images is too short for the network.

    Raises:
        ValueError: The shapes differ or are not [H, W, 3].
        WeightsError: This machine's weights are not the published ones.
    """
    image, target = inside(image, target, mask)
    published = weights.load_published()
    return None if published is None else _distance(image, target, published, weights.ALEX)


def lpips_vgg(image: Tensor, target: Tensor, mask: Tensor | None = None) -> float | None:
    """Compute the perceptual distance LPIPS, version 0.1, with VGG16 (`vgg` in gsplat).

    It takes about 3 s for a view of 500 x 375 px on one core, and four times as long for twice the
    size. All else is as for `lpips`, except that a machine without weights is a WeightsError.
    """
    image, target = inside(image, target, mask)
    return _distance(image, target, weights.load_vgg(), weights.VGG)


def _distance(
    image: Tensor, target: Tensor, published: weights.Weights, network: weights.Network
) -> float | None:
    if min(image.shape[:2]) < network.min_side:
        return None
    import torch

    from xrgs.evaluation.lpips.network import distance

    tensors = {name: torch.from_numpy(array) for name, array in published.items()}
    return float(distance(image, target, tensors, network))
