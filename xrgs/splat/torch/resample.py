"""Image resampling as a product with one matrix an axis."""

from __future__ import annotations

import torch
from torch import Tensor

from xrgs.splat.bicubic import bicubic_matrix


def resize(image: Tensor, height: int, width: int) -> Tensor:
    """Resample as `xrgs.splat.resample.resize` does, in any floating type."""
    rows = bicubic_matrix(image.shape[0], height).to(image.dtype)  # [height, H]
    columns = bicubic_matrix(image.shape[1], width).to(image.dtype)  # [width, W]
    return torch.einsum("ih,hwc,jw->ijc", rows, image, columns)
