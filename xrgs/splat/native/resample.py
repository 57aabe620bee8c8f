"""Image resampling by the compiled kernels, with matrices that store only the nonzero weights."""

from __future__ import annotations

from functools import cache
from math import ceil, sqrt
from typing import Any, NamedTuple

import torch
from scipy.special import ive
from torch import Tensor

from xrgs import _native
from xrgs.splat.native.arguments import require_float32
from xrgs.splat.resample import bicubic_matrix


class BandedMatrix(NamedTuple):
    """A matrix [new, old] whose rows have at most `taps` adjacent nonzero values."""

    first: Tensor  # [new] int32, column of a row's first weight
    weights: Tensor  # [new, taps] float32


def resize(image: Tensor, height: int, width: int, variances: Tensor | None = None) -> Tensor:
    """Resample an image as `xrgs.splat.resample.resize` does; once differentiable.

    The backward pass multiplies by the exact transpose. Image and gradient have the same bits for
    any number of threads. An infinite or NaN pixel affects only the samples within its filter.
    """
    require_float32("image", image)
    resized: Tensor
    if variances is None:
        resized = _Resize.apply(image, height, width)
    else:
        resized = _BlurredResize.apply(image, variances, height, width)
    return resized


@cache
def banded_matrix(old: int, new: int, *, transposed: bool = False) -> BandedMatrix:
    """Return `bicubic_matrix(old, new)` [new, old], or its transpose, without its zeros."""
    dense = bicubic_matrix(old, new).T if transposed else bicubic_matrix(old, new)
    nonzero = dense != 0
    column = torch.arange(dense.shape[1])
    # A row without weights (a pixel between the samples of a much smaller image) may have any band.
    first = torch.where(nonzero, column, dense.shape[1] - 1).amin(dim=1)
    last = torch.where(nonzero, column, 0).amax(dim=1)
    taps = max(1, int((last - first).max()) + 1)
    first = first.clamp_max(dense.shape[1] - taps)  # leading weights are then zero
    weights = dense.gather(1, first[:, None] + torch.arange(taps))  # [new, taps]
    return BandedMatrix(first.int(), weights.float().contiguous())


class _BlurredAxis:
    """Blurs an axis and resamples it: `bicubic_matrix(old, new)` times the matrix of the blur.

    The matrices differ for each variance, so they are not cached, and made as bands directly.
    """

    def __init__(self, old: int, new: int, variance: float) -> None:
        """Compute the kernel and the matrix, for a variance in px^2 before resampling."""
        self.old, self.new = old, new
        # exp(-t) I_n(t) at n px, for the variance t. Beyond five standard deviations it is below
        # float32's precision; 4 px more are for the longer tails of a variance far below 1.
        half = torch.from_numpy(ive(range(ceil(5 * sqrt(variance)) + 4), variance))
        kernel = torch.cat([half.flip(0)[:-1], half])
        self.kernel = kernel / kernel.sum()
        self.matrix = self._resampled(self.kernel)

    def transposed(self) -> BandedMatrix:
        """Return the transpose [old, new], for the backward pass."""
        first, weights = self.matrix
        taps = weights.shape[1]
        column = torch.arange(self.old, dtype=first.dtype)
        above = torch.searchsorted(first + taps, column, right=True)  # first row with the column
        below = torch.searchsorted(first, column, right=True)
        count = int((below - above).max())
        above = above.clamp_max(self.new - count)
        row = above[:, None] + torch.arange(count)  # [old, count]
        tap = column[:, None] - first[row]
        inside = (tap >= 0) & (tap < taps)
        transposed = torch.where(inside, weights[row, tap.clamp(0, taps - 1)], 0)
        return BandedMatrix(above.int(), transposed)

    def slope(self) -> BandedMatrix:
        """Return the derivative of the matrix by the variance."""
        # The blur solves the heat equation: the derivative is half the second difference.
        return self._resampled(torch.nn.functional.pad(self.kernel, (2, 2)).diff(n=2) / 2)

    def _resampled(self, kernel: Tensor) -> BandedMatrix:
        """Return resampling after a convolution with `kernel` that reflects at the borders."""
        first, weights = banded_matrix(self.old, self.new)
        taps, size = weights.shape[1], len(kernel)
        lag = torch.arange(taps + size - 1) - torch.arange(taps)[:, None]
        inside = (lag >= 0) & (lag < size)
        shifted = torch.where(inside, kernel[lag.clamp(0, size - 1)], 0)
        wide = weights.double() @ shifted  # [new, taps + size - 1]
        start = first[:, None] - size // 2
        column = (start + torch.arange(wide.shape[1])) % (2 * self.old)  # the reflections' period
        column = torch.where(column < self.old, column, 2 * self.old - 1 - column)
        band = min(wide.shape[1], self.old)
        start = start.clamp(0, self.old - band)
        folded = wide.new_zeros(self.new, band).scatter_add_(1, column - start, wide)
        return BandedMatrix(start[:, 0].int(), folded.float())


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


class _BlurredResize(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, image: Tensor, variances: Tensor, height: int, width: int) -> Tensor:
        sizes = zip(image.shape, (height, width), variances.tolist(), strict=False)
        ctx.axes = [_BlurredAxis(*size) for size in sizes]
        ctx.save_for_backward(image)
        return _resample(image, *(axis.matrix for axis in ctx.axes))

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, v_resized: Tensor) -> tuple[Tensor, Tensor, None, None]:
        (image,), (rows, columns) = ctx.saved_tensors, ctx.axes
        v_image = _resample(v_resized, rows.transposed(), columns.transposed())
        slopes = (
            _resample(image, rows.slope(), columns.matrix),
            _resample(image, rows.matrix, columns.slope()),
        )
        # In double, since the order in which torch adds depends on processor and thread count.
        sums = [(v_resized * slope).sum(dtype=torch.float64) for slope in slopes]
        return v_image, torch.stack(sums), None, None


def _resample(image: Tensor, rows: BandedMatrix, columns: BandedMatrix) -> Tensor:
    contiguous = image.detach().contiguous()
    return _native.resample(contiguous, *rows, *columns, torch.get_num_threads())
