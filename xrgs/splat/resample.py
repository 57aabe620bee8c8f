"""Images at another resolution, differentiably: the phi between HR and LR."""

from __future__ import annotations

from functools import cache

import torch
from torch import Tensor
from torch.nn.functional import interpolate

from xrgs.splat.backend import resolve_backend


def resize(image: Tensor, height: int, width: int, *, backend: str = "torch") -> Tensor:
    """An image at another size, up or down each axis: antialiased bicubic, unclamped.

    torch's `interpolate(mode="bicubic", antialias=True)` to rounding, written as the two matrices
    that it is: forward and backward take a quarter of its time, and natively a tenth of that.

    Args:
        image: [H, W, 3]
        height: Of the result, px.
        width: Of the result, px.
        backend: `torch`, `native` or `auto` (`resolve_backend`). The native one is for float32 on
            the CPU.

    Returns:
        [height, width, 3]

    Raises:
        ValueError: `image` is no [H, W, 3], has no pixel or isn't what the native backend is for,
            or a size is below 1.
    """
    if image.ndim != 3 or image.shape[2] != 3 or 0 in image.shape:
        raise ValueError(f"image must be [H, W, 3] with H and W above 0, got {list(image.shape)}")
    if height < 1 or width < 1:
        raise ValueError(f"height and width must be at least 1, got {height} and {width}")
    if resolve_backend(backend) == "native":
        from xrgs.splat.native import resample as native_resample

        return native_resample.resize(image, height, width)
    rows = matrix(image.shape[0], height).to(image.dtype)
    columns = matrix(image.shape[1], width).to(image.dtype)
    return torch.einsum("ih,hwc,jw->ijc", rows, image, columns)


@cache
def matrix(old: int, new: int) -> Tensor:
    """[new, old] float64: what each of `new` samples takes from each of `old`."""
    identity = torch.eye(old, dtype=torch.float64)[None, None]  # [1, 1, old, old]
    return interpolate(identity, size=(new, old), mode="bicubic", antialias=True)[0, 0]
