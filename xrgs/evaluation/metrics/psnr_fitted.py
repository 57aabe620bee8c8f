"""Peak signal-to-noise ratio after a fit of the colours."""

from __future__ import annotations

from typing import TYPE_CHECKING

from xrgs.evaluation.metrics.base import inside
from xrgs.evaluation.metrics.psnr import psnr

if TYPE_CHECKING:
    from torch import Tensor


def psnr_fitted(image: Tensor, target: Tensor, mask: Tensor | None = None) -> float | None:
    """Compute `psnr` after the best affine colour map from the render to the photograph.

    The map M c + b, 3 x 3 and 3, minimises the sum of squared differences over the used pixels, in
    float64. The mapped render is clamped to 0..1. So differences of exposure and white balance
    between a photograph and the others do not count. Training does not use the map.

    "Colour-corrected" scores are common if training fits exposures, but with other maps: `cc_psnr`
    of gsplat 1.6.0 [ye2025] fits a line from photograph to render in each channel and inverts it,
    or fits the photograph by a quadratic function of the render's three channels, which is the only
    map of 1.5.3. So their values are not comparable. Arguments and errors are those of `psnr`.

    Returns:
        The ratio, dB, up to rounding at least that of `psnr`. None if no pixel is used.
    """
    import torch

    inside(image, target, mask)  # checks the shapes
    used = torch.ones(image.shape[:2], dtype=torch.bool) if mask is None else mask
    colors = torch.cat([image.double(), image.new_ones(*image.shape[:2], 1).double()], dim=-1)
    inputs, outputs = colors[used], target.double()[used]  # [N, 4], [N, 3]
    # By the pseudo-inverse, since the map of a render with a single colour is not unique.
    fit = torch.linalg.pinv(inputs.T @ inputs, hermitian=True) @ (inputs.T @ outputs)
    return psnr((colors @ fit).clamp(0, 1), target, mask)
