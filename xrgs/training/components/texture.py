"""How much detail a photograph shows, where (paper 7.2: "via Fourier or gradient magnitude")."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import pad


def gradient_magnitude(image: Tensor) -> Tensor:
    """Size of the intensity's slope at each pixel.

    The root of the mean over channels of the two squared differences to the next pixel. A pixel is
    the unit of length, so this is what the image shows near its own limit of resolution: of an LR
    view, whether there was detail beyond.

    Args:
        image: [H, W, 3] in 0..1, at least 2 x 2 px.

    Returns:
        [H, W] intensity a pixel, at most sqrt(2); the last row and column repeat the ones before.
    """
    inner = image[:-1, :-1]
    squared = (image[:-1, 1:] - inner).square() + (image[1:, :-1] - inner).square()
    slope: Tensor = torch.sqrt(squared.mean(dim=-1))  # [H - 1, W - 1]
    return pad(slope[None], (0, 1, 0, 1), mode="replicate")[0]
