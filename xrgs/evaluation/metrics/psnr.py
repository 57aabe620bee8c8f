"""Peak signal-to-noise ratio."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from xrgs.evaluation.metrics.base import inside

if TYPE_CHECKING:
    from torch import Tensor


def psnr(image: Tensor, target: Tensor, mask: Tensor | None = None) -> float | None:
    """Compute the peak signal-to-noise ratio 10 log10(1 / mean((image - target)²)).

    The mean is taken in float64 over the used pixels and all channels.

    Args:
        image: The render, [H, W, 3] in 0..1.
        target: The photograph, [H, W, 3] in 0..1.
        mask: [H, W] bool, True for a used pixel; None uses all.

    Returns:
        The ratio, dB; infinity for identical images, as in scikit-image (tables show no percentage
        change from or to infinity). None if no pixel is used.

    Raises:
        ValueError: The shapes differ or are not [H, W, 3].

    Examples:
        >>> import torch
        >>> round(psnr(torch.zeros(2, 2, 3), torch.full((2, 2, 3), 0.5)), 4)
        6.0206
    """
    image, target = inside(image, target, mask)
    total = float((image.double() - target.double()).square().sum())
    count = target.numel() if mask is None else 3 * int(mask.sum())
    if count == 0:
        return None
    return 10 * math.log10(1 / (total / count)) if total else math.inf


def psnr_plain(image: Tensor, target: Tensor, mask: Tensor | None = None) -> float | None:
    """Compute `psnr` without the mask; None if there is no mask, since `psnr` is the same then."""
    return None if mask is None else psnr(image, target)
