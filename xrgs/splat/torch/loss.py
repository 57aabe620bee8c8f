"""The photometric loss in plain torch, with gradients by autograd."""

from __future__ import annotations

import torch
from torch import Tensor

from xrgs.splat.ssim import C1, C2, WINDOW, Target, window_mean, window_moments

#: Rows of windows whose moments are computed at once. At 1,008 px they stay in the processor's
#: cache, and the moments take a tenth of the time of all rows at once.
_ROWS = 32


def target_moments(image: Tensor) -> tuple[Tensor, Tensor]:
    """Return the mean and the variance of a photograph under the window (`Target`).

    Args:
        image: [H, W, 3], of any floating type, contiguous, without a graph.

    Returns:
        Mean and variance, [H - 10, W - 10, 3] each, of the image's type.
    """
    height, width = image.shape[:2]
    mean, variance = (image.new_empty(height - WINDOW + 1, width - WINDOW + 1, 3) for _ in range(2))
    for row in range(0, len(mean), _ROWS):
        rows = slice(row, row + _ROWS)
        # In double, since a variance is a small difference of squares.
        moments = window_moments(image[row : row + _ROWS + WINDOW - 1].double())
        mean[rows], variance[rows] = moments
    return mean, variance


def photometric_loss(
    image: Tensor, target: Target, l1: float, ssim: float, pixel_weight: Tensor | None
) -> Tensor:
    """Return `xrgs.splat.loss.photometric_loss`; its checks have passed.

    Args:
        image: [H, W, 3] render, of any floating type and strides.
        target: The photograph, of the same shape and type.
        l1: Weight of the absolute difference.
        ssim: Weight of the structural dissimilarity.
        pixel_weight: [H, W]; None weighs all pixels 1.

    Returns:
        A scalar.
    """
    difference = (image - target.image).abs()  # [H, W, 3]
    dissimilarity = dissimilarity_map(image, target)  # [H - 10, W - 10, 3]
    if pixel_weight is not None:
        border = WINDOW // 2
        difference = pixel_weight[..., None] * difference
        dissimilarity = pixel_weight[border:-border, border:-border, None] * dissimilarity
    return l1 * difference.mean() + ssim * dissimilarity.mean()


def dissimilarity_map(image: Tensor, target: Target) -> Tensor:
    """Return 1 - SSIM of every window that lies inside the image [wang2004, equation 13].

    The data range is 1, and no window is padded: what gsplat's trainer calls as
    `fused_ssim(padding="valid")`.

    SSIM is luminance times structure. Where the image is almost its target both are almost 1, and
    in float32 their difference from 1 would be rounding. So that nothing cancels, the differences
    are computed from the moments of d = x - t, the difference of image and target:

        1 - luminance = E[d]^2 / (mean_x^2 + mean_t^2 + C1)
        1 - structure = var_d / (var_x + var_t + C2), where var_x = var_t + 2 cov(t, d) + var_d
        1 - SSIM = (1 - structure) luminance + (1 - luminance)

    Args:
        image: [H, W, 3] render, of any floating type.
        target: The photograph, of the same shape and type.

    Returns:
        [H - 10, W - 10, 3], one value for each window, in 0..2 but for rounding.
    """
    difference = image - target.image
    products = torch.cat(
        [difference, difference * difference, target.image * difference], dim=-1
    )  # [H, W, 9]
    mean, square, product = window_mean(products).chunk(3, dim=-1)  # [H - 10, W - 10, 3] each
    covariance = product - target.mean * mean
    # Rounding makes the variance of a flat image negative, and far outside 0..1 below -C2.
    variance = (square - mean * mean).clamp_min(0)
    image_variance = (target.variance + 2 * covariance + variance).clamp_min(0)
    image_mean = target.mean + mean
    squares = image_mean * image_mean + target.mean * target.mean + C1
    luminance = (2 * image_mean * target.mean + C1) / squares
    lacking_structure = variance / (image_variance + target.variance + C2)
    return lacking_structure * luminance + mean * mean / squares
