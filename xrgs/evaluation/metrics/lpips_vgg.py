"""Perceptual distance LPIPS with VGG16."""

from __future__ import annotations

from typing import TYPE_CHECKING

from xrgs.evaluation.lpips.weights import VGG, load_vgg
from xrgs.evaluation.metrics.base import inside

if TYPE_CHECKING:
    from torch import Tensor


def lpips_vgg(image: Tensor, target: Tensor, mask: Tensor | None = None) -> float | None:
    """Compute the perceptual distance LPIPS, version 0.1, with VGG16 (`vgg` in gsplat).

    It takes about 3 s for a view of 500 x 375 px on one core, and four times as long for twice the
    size. Source: [zhang2018]; see `xrgs.evaluation.lpips.network`. All else is as for `lpips`,
    except that a machine without weights is a WeightsError.
    """
    image, target = inside(image, target, mask)
    known = load_vgg()
    if min(image.shape[:2]) < VGG.min_side:
        return None
    import torch

    from xrgs.evaluation.lpips.network import distance

    tensors = {name: torch.from_numpy(array) for name, array in known.items()}
    return float(distance(image, target, tensors, VGG))
