"""Image resampling by the compiled kernels, which store the few nonzero weights of each sample."""

from __future__ import annotations

from functools import cache
from typing import Any, NamedTuple

import torch
from torch import Tensor

from xrgs import _native
from xrgs.splat.bicubic import bicubic_matrix
from xrgs.splat.native.arguments import require_float32


class BandedMatrix(NamedTuple):
    """A matrix [new, old] whose rows are zero but for `taps` values side by side."""

    first: Tensor  # [new] int32, column of a row's first weight
    weights: Tensor  # [new, taps] float32


def resize(image: Tensor, height: int, width: int) -> Tensor:
    """Resample an image as `xrgs.splat.resample.resize` does; once differentiable.

    The gradient is the product with the exact transpose. Image and gradient have the same bits for
    any number of threads. A value that is not finite reaches only the samples in which its pixel
    has a weight.

    Args:
        image: [H, W, 3] float32 on the CPU, of any strides.
        height: Height of the result, px.
        width: Width of the result, px.

    Returns:
        [height, width, 3]

    Raises:
        ValueError: `image` is not float32 on the CPU.
    """
    require_float32("image", image)
    resized: Tensor = _Resize.apply(image, height, width)
    return resized


@cache
def banded_matrix(old: int, new: int, *, transposed: bool = False) -> BandedMatrix:
    """Return `bicubic_matrix(old, new)`, or its transpose, without its zeros.

    Args:
        old: Number of samples along the axis before resampling.
        new: Number of samples after it.
        transposed: Whether to return the transpose, which the gradient is multiplied by.

    Returns:
        The matrix [new, old], or [old, new] if transposed.
    """
    dense = bicubic_matrix(old, new).T if transposed else bicubic_matrix(old, new)
    nonzero = dense != 0
    column = torch.arange(dense.shape[1])
    # A row without a weight (a pixel between the samples of a much smaller image) takes any band.
    first = torch.where(nonzero, column, dense.shape[1] - 1).amin(dim=1)
    last = torch.where(nonzero, column, 0).amax(dim=1)
    taps = max(1, int((last - first).max()) + 1)
    first = first.clamp_max(dense.shape[1] - taps)  # weights before a row's own are zero
    weights = dense.gather(1, first[:, None] + torch.arange(taps))  # [new, taps]
    return BandedMatrix(first.int(), weights.float().contiguous())


class _Resize(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, image: Tensor, height: int, width: int) -> Tensor:
        old_height, old_width = image.shape[:2]
        ctx.sizes = (old_height, height), (old_width, width)
        return _resample(image, banded_matrix(old_height, height), banded_matrix(old_width, width))

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, v_resized: Tensor) -> tuple[Tensor, None, None]:
        rows, columns = (banded_matrix(*sizes, transposed=True) for sizes in ctx.sizes)
        return _resample(v_resized, rows, columns), None, None


def _resample(image: Tensor, rows: BandedMatrix, columns: BandedMatrix) -> Tensor:
    contiguous = image.detach().contiguous()
    return _native.resample(contiguous, *rows, *columns, torch.get_num_threads())
