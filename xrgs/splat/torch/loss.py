"""The photometric loss in plain torch, with gradients by autograd."""

from __future__ import annotations

import torch
from torch import Tensor

from xrgs.splat.loss import C1, C2, WINDOW, Target, window_mean, window_moments

#: Rows of windows that `target_moments` computes at once. At 1,008 px these fit in the processor's
#: cache, which takes a tenth of the time of all rows at once.
_ROWS = 32


def target_moments(image: Tensor) -> tuple[Tensor, Tensor]:
    """Return the mean and the variance of a photograph [H, W, 3] in each SSIM window (`Target`)."""
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
    """Compute `xrgs.splat.loss.photometric_loss` of checked arguments, in any floating type."""
    difference = (image - target.image).abs()  # [H, W, 3]
    dissimilarity = dissimilarity_map(image, target)  # [H - 10, W - 10, 3]
    if pixel_weight is not None:
        border = WINDOW // 2
        difference = pixel_weight[..., None] * difference
        dissimilarity = pixel_weight[border:-border, border:-border, None] * dissimilarity
    return l1 * difference.mean() + ssim * dissimilarity.mean()


def dissimilarity_map(image: Tensor, target: Target) -> Tensor:
    """Return 1 - SSIM of every window that lies inside the image [wang2004, equation 13].

    The data range is 1, and windows are not padded: `fused_ssim(padding="valid")` of gsplat's
    trainer.

    SSIM is luminance times structure. If the image nearly equals its target, both are nearly 1, and
    1 minus either would be only rounding error in float32. So 1 - luminance and 1 - structure are
    computed without cancellation, from the moments of d = x - t, image minus target:

        1 - luminance = E[d]^2 / (mean_x^2 + mean_t^2 + C1)
        1 - structure = var_d / (var_x + var_t + C2), where var_x = var_t + 2 cov(t, d) + var_d
        1 - SSIM = (1 - structure) luminance + (1 - luminance)

    Returns:
        [H - 10, W - 10, 3], one value for each window, in 0..2 up to rounding.
    """
    difference = image - target.image
    products = torch.cat(
        [difference, difference * difference, target.image * difference], dim=-1
    )  # [H, W, 9]
    mean, square, product = window_mean(products).chunk(3, dim=-1)  # [H - 10, W - 10, 3] each
    covariance = product - target.mean * mean
    # Rounding can make the variance of a flat image negative, for values far outside 0..1 even
    # below -C2.
    variance = (square - mean * mean).clamp_min(0)
    image_variance = (target.variance + 2 * covariance + variance).clamp_min(0)
    image_mean = target.mean + mean
    squares = image_mean * image_mean + target.mean * target.mean + C1
    luminance = (2 * image_mean * target.mean + C1) / squares
    lacking_structure = variance / (image_variance + target.variance + C2)
    return lacking_structure * luminance + mean * mean / squares
