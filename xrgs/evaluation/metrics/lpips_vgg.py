"""Perceptual distance LPIPS with VGG16."""

from __future__ import annotations

from typing import TYPE_CHECKING

from xrgs.evaluation.lpips import vgg
from xrgs.evaluation.metrics.base import inside

if TYPE_CHECKING:
    from torch import Tensor


def lpips_vgg(image: Tensor, target: Tensor, mask: Tensor | None = None) -> float | None:
    """Compute the perceptual distance LPIPS, version 0.1, with VGG16 (`vgg` in gsplat).

    It takes about 3 s for a view of 500 x 375 px on one core, and four times as long for twice the
    size. Outside the mask both images are made equal; the distance is the mean over the whole
    image.

    Source: [zhang2018]; see `xrgs.evaluation.lpips.vgg`.

    Args:
        image: The render, [H, W, 3] in 0..1.
        target: The photograph, [H, W, 3] in 0..1.
        mask: [H, W] bool, True for a used pixel; None uses all.

    Returns:
        The distance, 0 for identical images; None (n/a in the tables) if a side of the images is
        too short for the network.

    Raises:
        ValueError: The shapes differ or are not [H, W, 3].
        WeightsError: This machine has no weights, or they are not the published ones.
    """
    image, target = inside(image, target, mask)
    known = vgg.load_published()
    if min(image.shape[:2]) < vgg.MIN_SIDE:
        return None
    import torch

    return float(vgg.distance(image, target, {k: torch.from_numpy(v) for k, v in known.items()}))
