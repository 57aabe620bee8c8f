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
    size. Source: [zhang2018]; see `xrgs.evaluation.lpips.vgg`. All else is as for `lpips`, except
    that a machine without weights is a WeightsError.
    """
    image, target = inside(image, target, mask)
    known = vgg.load_published()
    if min(image.shape[:2]) < vgg.MIN_SIDE:
        return None
    import torch

    return float(vgg.distance(image, target, {k: torch.from_numpy(v) for k, v in known.items()}))
