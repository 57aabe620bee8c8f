"""Peak signal-to-noise ratio."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from xrgs.evaluation.metrics.base import check_pair

if TYPE_CHECKING:
    from torch import Tensor


def psnr(image: Tensor, target: Tensor) -> float:
    """Compute the peak signal-to-noise ratio 10 log10(1 / mean((image - target)²)).

    The mean is taken in float64 over all pixels and channels.

    Args:
        image: The render, [H, W, 3] in 0..1.
        target: The photograph, [H, W, 3] in 0..1.

    Returns:
        The ratio in dB; infinity where the images are identical, as in scikit-image (tables show
        no percentage change from or to infinity).

    Raises:
        ValueError: The shapes differ or are not [H, W, 3].

    Example:
        >>> import torch
        >>> round(psnr(torch.zeros(2, 2, 3), torch.full((2, 2, 3), 0.5)), 4)
        6.0206
    """
    check_pair(image, target)
    error = float((image.double() - target.double()).square().mean())
    return 10 * math.log10(1 / error) if error else math.inf
