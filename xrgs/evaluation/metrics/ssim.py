"""Structural similarity, as kornia computes it."""

from __future__ import annotations

from typing import TYPE_CHECKING

from xrgs.evaluation.metrics.base import inside

if TYPE_CHECKING:
    from torch import Tensor

#: Side of the window, px. It is separate from that of the training loss, so that a change there
#: does not change the scores.
SSIM_WINDOW = 11


def ssim(image: Tensor, target: Tensor, mask: Tensor | None = None) -> float | None:
    """Compute the structural similarity, averaged over channels and used pixels.

    Windows across the border of the mask compare equal pixels outside it. The function is
    `kornia.metrics.ssim`: a Gaussian window of 11 x 11 px and sigma 1.5 px, data range 1, reflected
    borders. gsplat's evaluation gives the same to the fourth digit.

    Source: [wang2004] "Image quality assessment: from error visibility to structural
    similarity". Arguments as for `psnr`.

    Returns:
        A value in -1..1; 1 for identical images. None if no pixel is used.

    Raises:
        ValueError: The shapes differ or are not [H, W, 3], or a side is too short for reflected
            borders.
    """
    from kornia import metrics

    image, target = inside(image, target, mask)
    height, width = image.shape[:2]
    if min(height, width) <= SSIM_WINDOW // 2:
        raise ValueError(
            f"an image of {width} x {height} px is too small for SSIM: each side must have more "
            f"than {SSIM_WINDOW // 2} px"
        )
    planes, reference = (x.permute(2, 0, 1)[None] for x in (image, target))  # [1, 3, H, W]
    values = metrics.ssim(planes, reference, window_size=SSIM_WINDOW)  # [1, 3, H, W]
    if mask is None:
        return float(values.mean())
    return float(values[..., mask].mean()) if mask.any() else None
