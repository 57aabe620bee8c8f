"""The Gaussian window of the SSIM [wang2004, section III-C], and mean and variance within it.

The training loss uses these constants; the compiled kernels of the loss repeat them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import conv2d

from xrgs.splat.settings import SSIM_WINDOW

WINDOW = SSIM_WINDOW
"""Side of the window, px."""
SIGMA = 1.5
"""Standard deviation of the window, px."""
_TAPS = [math.exp(-((tap - WINDOW // 2) ** 2) / (2 * SIGMA**2)) for tap in range(WINDOW)]
WEIGHTS = tuple(tap / math.fsum(_TAPS) for tap in _TAPS)
"""Weights of the window along one axis; their sum is 1."""
C1 = 0.01**2
"""(K1 L)^2 with K1 = 0.01, for a data range L of 1."""
C2 = 0.03**2
"""(K2 L)^2 with K2 = 0.03, for a data range L of 1."""


@dataclass(frozen=True)
class Target:
    """A photograph and its SSIM statistics, which are computed once for each view."""

    image: Tensor  # [H, W, 3]
    mean: Tensor  # [H - 10, W - 10, 3] of each window
    variance: Tensor  # [H - 10, W - 10, 3] of each window, never negative


def window_mean(image: Tensor) -> Tensor:
    """Return the weighted mean [H - 10, W - 10, C] of every window inside an image [H, W, C]."""
    channels = image.shape[-1]
    kernel = image.new_tensor(WEIGHTS)  # [11]
    # `image[None].permute`, not `image.permute()[None]`: only then does oneDNN treat the tensor as
    # channels-last, and its depth-wise kernel is five times as fast (2 threads, 504 x 378 px).
    planes: Tensor = image[None].permute(0, 3, 1, 2)  # [1, C, H, W]
    planes = conv2d(planes, kernel.view(1, 1, 1, -1).expand(channels, 1, 1, -1), groups=channels)
    planes = conv2d(planes, kernel.view(1, 1, -1, 1).expand(channels, 1, -1, 1), groups=channels)
    means: Tensor = planes.permute(0, 2, 3, 1)[0]
    return means


def window_moments(image: Tensor) -> tuple[Tensor, Tensor]:
    """Return the weighted mean and variance of every window inside an image [H, W, C].

    Both are [H - 10, W - 10, C]. A variance that rounding makes negative is 0.
    """
    # Summed in a fixed order. A convolution's order depends on the processor, which would change
    # many digits of a variance, since it is a small difference of squares.
    moments = torch.cat([image, image * image], dim=-1)
    for axis in (0, 1):
        moments = _weighted_sum(moments, axis)
    mean, square = moments.chunk(2, dim=-1)
    return mean, (square - mean * mean).clamp_min(0)


def _weighted_sum(image: Tensor, axis: int) -> Tensor:
    """Return the weighted sums along one axis of all windows that lie inside the image."""
    first, *others = WEIGHTS
    length = image.shape[axis] - WINDOW + 1
    total = image.narrow(axis, 0, length) * first
    term = torch.empty_like(total)
    for tap, weight in enumerate(others, 1):
        total += torch.mul(image.narrow(axis, tap, length), weight, out=term)
    return total
