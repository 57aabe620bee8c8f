"""The photometric loss of 3D Gaussian Splatting: L1 and structural dissimilarity.

3D Gaussian Splatting [kerbl2023, section 5.1, equation 7]: (1 - lambda) L1 + lambda D-SSIM
with lambda = 0.2. D-SSIM is 1 - SSIM, as in the code of that paper and in gsplat.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import conv2d

from xrgs.splat.backend import implementation
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


__all__ = ["WINDOW", "Target", "photometric_loss", "prepare_target"]


def prepare_target(image: Tensor, *, backend: str = "torch") -> Target:
    """Compute the SSIM statistics of a photograph, once for all steps on it.

    Args:
        image: [H, W, 3], values in 0..1; bicubic resampling may overshoot a little.
        backend: `torch`, `native` or `auto` (`resolve_backend`). The native backend takes float32
            on the CPU only, and gives the same bits.

    Returns:
        The photograph and its statistics, of its dtype, detached from autograd.

    Raises:
        ValueError: `image` is not [H, W, 3] or is smaller than the SSIM window, or the backend is
            native and `image` is not float32 on the CPU.
    """
    if image.ndim != 3 or image.shape[2] != 3:
        raise ValueError(f"image must be [H, W, 3], got {list(image.shape)}")
    height, width = image.shape[:2]
    if min(height, width) < WINDOW:
        raise ValueError(
            f"image of {width} x {height} px is smaller than the SSIM window of {WINDOW} px"
        )
    image = image.detach().contiguous()
    return Target(image, *implementation("loss", backend).target_moments(image))


def photometric_loss(
    image: Tensor,
    target: Target,
    *,
    l1: float,
    ssim: float,
    pixel_weight: Tensor | None = None,
    backend: str = "torch",
) -> Tensor:
    """Return `l1 * mean |image - target| + ssim * (1 - SSIM(image, target))`.

    gsplat's trainer has l1 0.8 and ssim 0.2 (`ssim_lambda` of `examples/simple_trainer.py`). The
    SSIM is averaged over the windows that lie inside the image.

    `pixel_weight` multiplies the absolute difference of each pixel, and 1 - SSIM of the window
    centred on it, before the two means are taken. The weights are not normalised: a weight of w
    everywhere gives w times the loss.

    Args:
        image: [H, W, 3] render, of the target's dtype.
        target: The photograph, from `prepare_target`.
        l1: Weight of the absolute difference.
        ssim: Weight of the structural dissimilarity.
        pixel_weight: [H, W]; None weighs all pixels 1.
        backend: `torch`, `native` or `auto` (`resolve_backend`). The native backend takes float32
            on the CPU only, and differentiates only with respect to `image`.

    Returns:
        A scalar.

    Raises:
        ValueError: `image` or `pixel_weight` does not have the target's size; or the backend is
            native, and a tensor is not float32 on the CPU or `pixel_weight` requires a gradient.
    """
    if image.shape != target.image.shape:
        raise ValueError(
            f"image is {list(image.shape)}, its target {list(target.image.shape)} [H, W, 3]"
        )
    if pixel_weight is not None and pixel_weight.shape != image.shape[:2]:
        raise ValueError(
            f"pixel_weight must be {list(image.shape[:2])} [H, W], got {list(pixel_weight.shape)}"
        )
    loss: Tensor = implementation("loss", backend).photometric_loss(
        image, target, l1, ssim, pixel_weight
    )
    return loss
