"""Image resampling as a product with one matrix an axis."""

from __future__ import annotations

import torch
from torch import Tensor

from xrgs.splat.bicubic import bicubic_matrix


def resize(image: Tensor, height: int, width: int) -> Tensor:
    """Resample an image as `xrgs.splat.resample.resize` does, whose checks have passed.

    Args:
        image: [H, W, 3], of any floating type.
        height: Height of the result, px.
        width: Width of the result, px.

    Returns:
        [height, width, 3]
    """
    rows = bicubic_matrix(image.shape[0], height).to(image.dtype)  # [height, H]
    columns = bicubic_matrix(image.shape[1], width).to(image.dtype)  # [width, W]
    return torch.einsum("ih,hwc,jw->ijc", rows, image, columns)
