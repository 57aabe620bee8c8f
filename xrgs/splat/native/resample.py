"""Resizing by the compiled kernels: the few weights of each sample in place of whole matrices."""

from __future__ import annotations

from functools import cache
from typing import Any, NamedTuple

import torch
from torch import Tensor

from xrgs import _native
from xrgs.splat.resample import matrix


class Bands(NamedTuple):
    """A matrix whose rows are zero but for a few values side by side."""

    first: Tensor  # [new] int32, column of a row's first weight
    weights: Tensor  # [new, taps] float32


def resize(image: Tensor, height: int, width: int) -> Tensor:
    """`xrgs.splat.resample.resize` of a float32 image on the CPU, once differentiable.

    Its gradient is by the exact transpose. Both are bitwise the same for any number of threads.
    What is not finite stays within the samples that its pixel has a weight in.

    Args:
        image: [H, W, 3], of any strides.
        height: Of the result, px.
        width: Of the result, px.

    Returns:
        [height, width, 3]

    Raises:
        ValueError: `image` isn't float32 on the CPU.
    """
    if image.dtype != torch.float32 or image.device.type != "cpu":
        raise ValueError(
            f"image must be float32 on the CPU for the native backend, got {image.dtype} on"
            f" {image.device}"
        )
    resized: Tensor = _Resize.apply(image, height, width)
    return resized


@cache
def bands(old: int, new: int, *, transposed: bool = False) -> Bands:
    """`matrix(old, new)`, or its transpose, without its zeros."""
    dense = matrix(old, new).T if transposed else matrix(old, new)
    used = dense != 0
    place = torch.arange(dense.shape[1])
    # A row without a weight (a pixel between the samples of a much smaller image) takes any band.
    first = torch.where(used, place, dense.shape[1] - 1).amin(dim=1)
    last = torch.where(used, place, 0).amax(dim=1)
    taps = max(1, int((last - first).max()) + 1)
    first = first.clamp_max(dense.shape[1] - taps)  # weights before a row's own are zero
    weights = dense.gather(1, first[:, None] + torch.arange(taps))
    return Bands(first.int(), weights.float().contiguous())


class _Resize(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, image: Tensor, height: int, width: int) -> Tensor:
        old_height, old_width = image.shape[:2]
        ctx.sizes = (old_height, height), (old_width, width)
        return _resample(image, bands(old_height, height), bands(old_width, width))

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, slope: Tensor) -> tuple[Tensor, None, None]:
        rows, columns = (bands(*sizes, transposed=True) for sizes in ctx.sizes)
        return _resample(slope, rows, columns), None, None


def _resample(image: Tensor, rows: Bands, columns: Bands) -> Tensor:
    plain = image.detach().contiguous()
    return _native.resample(plain, *rows, *columns, torch.get_num_threads())
