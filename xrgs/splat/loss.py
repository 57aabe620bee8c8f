"""The photometric loss of 3D Gaussian Splatting: L1 and structural dissimilarity."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import conv2d

from xrgs.splat.backend import resolve_backend

WINDOW = 11
"""Taps of the SSIM window along each axis."""
SIGMA = 1.5
"""Its standard deviation, px."""
# (K1 L)^2 and (K2 L)^2 of Wang et al. 2004, for a data range L of 1.
C1 = 0.01**2
C2 = 0.03**2


@dataclass(frozen=True)
class Target:
    """A photograph and its half of the SSIM, which never change and are computed once a view."""

    image: Tensor  # [H, W, 3]
    mean: Tensor  # [H - 10, W - 10, 3] under the window
    variance: Tensor  # [H - 10, W - 10, 3] under the window, never negative


def prepare_target(image: Tensor) -> Target:
    """The statistics of a view that `photometric_loss` needs.

    Args:
        image: [H, W, 3], values of range 1; a resampled photograph may leave 0..1.

    Raises:
        ValueError: `image` is no [H, W, 3] or is smaller than the SSIM window.
    """
    if image.ndim != 3 or image.shape[2] != 3:
        raise ValueError(f"image must be [H, W, 3], got {list(image.shape)}")
    height, width = image.shape[:2]
    if min(height, width) < WINDOW:
        raise ValueError(
            f"image of {width} x {height} px is smaller than the SSIM window of {WINDOW} px"
        )
    image = image.detach().contiguous()
    # In double, since a variance is a small difference of squares, and this is done once a view.
    mean, variance = (x.to(image.dtype) for x in _moments(image.double()))
    return Target(image, mean.contiguous(), variance.contiguous())


def photometric_loss(
    image: Tensor,
    target: Target,
    *,
    l1: float,
    ssim: float,
    pixel_weight: Tensor | None = None,
    backend: str = "torch",
) -> Tensor:
    """`l1 * mean |image - target| + ssim * (1 - SSIM(image, target))`.

    gsplat's trainer has l1 0.8 and ssim 0.2 (`ssim_lambda`). With `pixel_weight` both means, of the
    absolute differences and of what each window's SSIM lacks to 1, are those of the values times
    the weight of their pixel, the window's centre: a weight of w everywhere is w times the loss.

    Args:
        image: [H, W, 3] render, of the target's dtype.
        target: What it should look like.
        l1: Weight of the absolute difference.
        ssim: Weight of the structural dissimilarity.
        pixel_weight: [H, W]; None weighs all pixels 1.
        backend: `torch`, `native` or `auto` (`resolve_backend`). The native one is for float32 on
            the CPU, and computes the gradient along with the value; it has no pixel weights, with
            which torch computes the loss whatever the backend.

    Returns:
        A scalar.

    Raises:
        ValueError: `image` hasn't the target's shape, `pixel_weight` isn't of its size, or `image`
            isn't what the native backend is for.
    """
    if pixel_weight is not None:
        return _weighted_loss(image, _same_shape(image, target), l1, ssim, pixel_weight)
    if resolve_backend(backend) == "native":
        from xrgs.splat.native import loss as native_loss

        return native_loss.photometric_loss(image, _same_shape(image, target), l1, ssim)
    difference = (image - _same_shape(image, target).image).abs().mean()
    return l1 * difference + ssim * (1 - structural_similarity(image, target))


def structural_similarity(image: Tensor, target: Target) -> Tensor:
    """Mean SSIM where the whole window lies inside the image (padding "valid").

    Wang et al. 2004, Gaussian window of 11 taps and sigma 1.5, data range 1, as gsplat's trainer
    calls it (`fused_ssim(padding="valid")`). The mean is over pixels and channels.

    Args:
        image: [H, W, 3] render, of the target's dtype.
        target: What it should look like.

    Returns:
        A scalar in [-1, 1].

    Raises:
        ValueError: `image` hasn't the target's shape.
    """
    return _similarity(image, _same_shape(image, target)).mean()


def _weighted_loss(image: Tensor, target: Target, l1: float, ssim: float, weight: Tensor) -> Tensor:
    if weight.shape != image.shape[:2]:
        raise ValueError(
            f"pixel_weight must be {list(image.shape[:2])} [H, W], got {list(weight.shape)}"
        )
    difference = (image - target.image).abs().mean(dim=-1)  # [H, W]
    lacking = 1 - _similarity(image, target).mean(dim=-1)  # [H - 10, W - 10]
    border = WINDOW // 2
    centres = weight[border:-border, border:-border]
    return l1 * (weight * difference).mean() + ssim * (centres * lacking).mean()


def _similarity(image: Tensor, y: Target) -> Tensor:
    """SSIM of the windows around the pixels that they fit around: [H - 10, W - 10, 3]."""
    products = torch.cat([image, image * image, image * y.image], dim=-1)  # [H, W, 9]
    mean, square, product = _blur(products).chunk(3, dim=-1)  # [H - 10, W - 10, 3] each
    # Rounding makes the variance of a flat image negative; far outside 0..1 that could outgrow C2.
    variance = (square - mean * mean).clamp_min(0)
    covariance = product - mean * y.mean
    luminance = (2 * mean * y.mean + C1) / (mean * mean + y.mean * y.mean + C1)
    structure = (2 * covariance + C2) / (variance + y.variance + C2)
    return luminance * structure


def _same_shape(image: Tensor, target: Target) -> Target:
    if image.shape != target.image.shape:
        raise ValueError(
            f"image is {list(image.shape)}, its target {list(target.image.shape)} [H, W, 3]"
        )
    return target


def _moments(image: Tensor) -> tuple[Tensor, Tensor]:
    mean, square = _blur(torch.cat([image, image * image], dim=-1)).chunk(2, dim=-1)
    return mean, (square - mean * mean).clamp_min(0)


def _blur(x: Tensor) -> Tensor:
    """[H, W, C] to [H - 10, W - 10, C]: the window's weighted mean around each pixel."""
    channels = x.shape[-1]
    taps = torch.arange(WINDOW, dtype=torch.float64) - WINDOW // 2
    kernel = torch.exp(-(taps**2) / (2 * SIGMA**2))
    kernel = (kernel / kernel.sum()).to(x)
    # `x[None].permute`, not `x.permute()[None]`: only then is it channels-last to oneDNN, whose
    # depth-wise kernel is five times as fast as one that gathers planes (2 threads, 504 x 378).
    planes: Tensor = x[None].permute(0, 3, 1, 2)
    planes = conv2d(planes, kernel.view(1, 1, 1, -1).expand(channels, 1, 1, -1), groups=channels)
    planes = conv2d(planes, kernel.view(1, 1, -1, 1).expand(channels, 1, -1, 1), groups=channels)
    blurred: Tensor = planes.permute(0, 2, 3, 1)[0]
    return blurred
