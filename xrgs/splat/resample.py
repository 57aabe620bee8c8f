"""Differentiable resampling of images: the projection phi from HR to LR (paper, section 5.6)."""

from __future__ import annotations

from functools import cache

import torch
from torch import Tensor
from torch.nn.functional import interpolate

from xrgs.splat.backend import implementation


def resize(
    image: Tensor,
    height: int,
    width: int,
    *,
    variances: Tensor | None = None,
    backend: str = "torch",
) -> Tensor:
    """Resample an image to another size with an antialiased bicubic filter, unclamped.

    With `variances`, the image is blurred first along each axis, by the discrete analogue of a
    Gaussian [lindeberg1990]. Its variance is exact even far below 1 px^2, where a sampled Gaussian
    is inaccurate. The image is reflected at the borders.

    The result is torch's `interpolate(mode="bicubic", antialias=True)` to rounding. It is computed
    as a product with one matrix for each axis: forward and backward take a quarter of the time of
    `interpolate`, and a fortieth on the native backend.

    Args:
        image: [H, W, 3], of any strides.
        height: Height of the result, px.
        width: Width of the result, px.
        variances: [2] variances of the blur along y and x, px^2 of `image`, at least 0; None does
            not blur.
        backend: `torch`, `native` or `auto` (`resolve_backend`). The native backend takes float32
            on the CPU only.

    Returns:
        [height, width, 3]. Differentiable in `image` and `variances`, on the native backend only
        once.

    Raises:
        ValueError: `image` is not [H, W, 3] or has no pixel, a size is below 1, or the backend is
            native and `image` is not float32 on the CPU.
    """
    if image.ndim != 3 or image.shape[2] != 3 or 0 in image.shape:
        raise ValueError(f"image must be [H, W, 3] with H and W above 0, got {list(image.shape)}")
    if height < 1 or width < 1:
        raise ValueError(f"height and width must be at least 1, got {height} and {width}")
    resized: Tensor = implementation("resample", backend).resize(image, height, width, variances)
    return resized


@cache
def bicubic_matrix(old: int, new: int) -> Tensor:
    """Return the weights of torch's `interpolate(mode="bicubic", antialias=True)` along one axis.

    Resampling is linear, so the weights are the interpolated identity matrix. Each row sums to 1.

    Returns:
        [new, old] float64 for numbers of samples before and after resampling. The matrix is cached:
        callers must not write to it.
    """
    identity = torch.eye(old, dtype=torch.float64)[None, None]  # [1, 1, old, old]
    return interpolate(identity, size=(new, old), mode="bicubic", antialias=True)[0, 0]
