"""Perceptual distance LPIPS."""

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
    if published is None:
        return None
    import torch

    from xrgs.evaluation.lpips.network import distance

    if min(image.shape[:2]) < weights.ALEX.min_side:
        return None
    return float(distance(image, target, {k: torch.from_numpy(v) for k, v in published.items()}))
