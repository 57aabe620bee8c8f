"""The photometric loss in plain torch, with gradients by autograd."""

from __future__ import annotations

import torch
from torch import Tensor

from xrgs.splat.ssim import C1, C2, WINDOW, Target, window_mean


def photometric_loss(image: Tensor, target: Target, l1: float, ssim: float) -> Tensor:
    """Return `xrgs.splat.loss.photometric_loss` without pixel weights; its checks have passed.

    Args:
        image: [H, W, 3] render, of any floating type and strides.
        target: The photograph, of the same shape and type.
        l1: Weight of the absolute difference.
        ssim: Weight of the structural dissimilarity.

    Returns:
        A scalar.
    """
    difference = (image - target.image).abs().mean()
    return l1 * difference + ssim * (1 - structural_similarity(image, target))


def weighted_photometric_loss(
    image: Tensor, target: Target, l1: float, ssim: float, pixel_weight: Tensor
) -> Tensor:
    """Return `xrgs.splat.loss.photometric_loss` with pixel weights; its checks have passed.

    Args:
        image: [H, W, 3] render, of any floating type and strides.
        target: The photograph, of the same shape and type.
        l1: Weight of the absolute difference.
        ssim: Weight of the structural dissimilarity.
        pixel_weight: [H, W]

    Returns:
        A scalar.
    """
    difference = (image - target.image).abs().mean(dim=-1)  # [H, W]
    dissimilarity = 1 - ssim_map(image, target).mean(dim=-1)  # [H - 10, W - 10]
    border = WINDOW // 2
    centre_weight = pixel_weight[border:-border, border:-border]  # [H - 10, W - 10]
    return l1 * (pixel_weight * difference).mean() + ssim * (centre_weight * dissimilarity).mean()


def structural_similarity(image: Tensor, target: Target) -> Tensor:
    """Return the mean SSIM over pixels and channels (padding "valid").

    [wang2004, equation 13] with a data range of 1: what gsplat's trainer calls as
    `fused_ssim(padding="valid")`.

    Args:
        image: [H, W, 3] render, of any floating type.
        target: The photograph, of the same shape and type.

    Returns:
        A scalar in [-1, 1].
    """
    return ssim_map(image, target).mean()


def ssim_map(image: Tensor, target: Target) -> Tensor:
    """Return the SSIM of every window that lies inside the image [wang2004, equation 13].

    Args:
        image: [H, W, 3] render, of any floating type.
        target: The photograph, of the same shape and type.

    Returns:
        [H - 10, W - 10, 3], each value that of the window around the pixel.
    """
    products = torch.cat([image, image * image, image * target.image], dim=-1)  # [H, W, 9]
    mean, square, product = window_mean(products).chunk(3, dim=-1)  # [H - 10, W - 10, 3] each
    # Rounding makes the variance of a flat image negative; far outside 0..1 that could outgrow C2.
    variance = (square - mean * mean).clamp_min(0)
    covariance = product - mean * target.mean
    luminance = (2 * mean * target.mean + C1) / (mean * mean + target.mean * target.mean + C1)
    structure = (2 * covariance + C2) / (variance + target.variance + C2)
    return luminance * structure
