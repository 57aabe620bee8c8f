"""Peak signal-to-noise ratio after a fit of the colours."""

from __future__ import annotations

from typing import TYPE_CHECKING

from xrgs.evaluation.metrics.base import inside
from xrgs.evaluation.metrics.psnr import psnr

if TYPE_CHECKING:
    from torch import Tensor


def psnr_fitted(image: Tensor, target: Tensor, mask: Tensor | None = None) -> float | None:
    """Compute `psnr` after the affine colour map that brings the render closest to the photograph.

    The map M c + b, 3 x 3 and 3, minimises the sum of squared differences over the used pixels, in
    float64. Its result is clamped to 0..1. A photograph of another exposure or white balance than
    the scene's is scored by what it shows. Training sees nothing of the map.

    Such "colour-corrected" scores are customary where training learns exposures, with other maps:
    `cc_psnr` of gsplat 1.6.0 [ye2025] fits a line from photograph to render in each channel by
    itself and inverts it, or fits the photograph by a quadratic function of the render's three
    channels, which is the only map of 1.5.3. So its numbers are not these.

    Args:
        image: The render, [H, W, 3] in 0..1.
        target: The photograph, [H, W, 3] in 0..1.
        mask: [H, W] bool, True for a pixel that is used; None uses all.

    Returns:
        The ratio in dB, not below that of `psnr` but for rounding. None where no pixel is used.

    Raises:
        ValueError: The shapes differ or are not [H, W, 3].
    """
    import torch

    inside(image, target, mask)  # checks the shapes
    used = torch.ones(image.shape[:2], dtype=torch.bool) if mask is None else mask
    colors = torch.cat([image.double(), image.new_ones(*image.shape[:2], 1).double()], dim=-1)
    inputs, outputs = colors[used], target.double()[used]  # [N, 4], [N, 3]
    # By the pseudo-inverse of a 4 x 4 matrix: a render of one colour has no unique map.
    fit = torch.linalg.pinv(inputs.T @ inputs, hermitian=True) @ (inputs.T @ outputs)
    return psnr((colors @ fit).clamp(0, 1), target, mask)
