"""Image resampling as a product with one matrix for each axis."""

from __future__ import annotations

import math
from functools import cache

import torch
from torch import Tensor

from xrgs.splat.resample import bicubic_matrix


def resize(image: Tensor, height: int, width: int, variances: Tensor | None = None) -> Tensor:
    """Resample as `xrgs.splat.resample.resize` does, in any floating type."""
    rows = bicubic_matrix(image.shape[0], height)  # [height, H]
    columns = bicubic_matrix(image.shape[1], width)  # [width, W]
    if variances is not None:
        rows, columns = rows @ _blur(rows, variances[0]), columns @ _blur(columns, variances[1])
    return torch.einsum("ih,hwc,jw->ijc", rows.to(image), image, columns.to(image))


def _blur(resampled: Tensor, variance: Tensor) -> Tensor:
    """Return the blur matrix [size, size] of the axis that `resampled` [., size] resamples.

    The discrete analogue of a Gaussian blur is the matrix exponential of half the variance times
    the second difference [lindeberg1990]. With reflected borders its eigenvectors are cosines.
    """
    size = resampled.shape[1]
    frequencies = torch.arange(size, dtype=torch.float64) * (math.pi / size)
    decay = torch.exp(-variance.double() * (1 - frequencies.cos()))
    cosines = _cosines(size)
    return (cosines.T * decay) @ cosines


@cache
def _cosines(size: int) -> Tensor:
    """Return the orthonormal discrete cosine transform [frequencies, samples], float64."""
    frequency, sample = torch.meshgrid(*2 * [torch.arange(size).double()], indexing="ij")
    waves = torch.cos(math.pi / size * frequency * (sample + 0.5)) * math.sqrt(2 / size)
    return torch.where(frequency == 0, math.sqrt(1 / size), waves)
