"""The photometric loss by the compiled kernel: value and gradient in one pass over the image."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from xrgs import _native
from xrgs.splat.native.arguments import require_float32
from xrgs.splat.ssim import Target


def photometric_loss(image: Tensor, target: Target, l1: float, ssim: float) -> Tensor:
    """Return `xrgs.splat.loss.photometric_loss` without pixel weights; once differentiable.

    Sums are kept in double and added in a fixed order: value and gradient are bitwise the same for
    any number of threads. Where the image or its target is NaN, so are the loss and the gradient
    of the pixels under the same windows.

    Args:
        image: [H, W, 3] render, float32 on the CPU, of any strides.
        target: The photograph, of the same shape and type.
        l1: Weight of the absolute difference.
        ssim: Weight of the structural dissimilarity.

    Returns:
        A scalar.

    Raises:
        ValueError: `image` or `target` is not float32 on the CPU.
    """
    require_float32("image", image)
    require_float32("target", target.image)
    loss: Tensor = _Photometric.apply(image, target, l1, ssim)
    return loss


class _Photometric(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, image: Tensor, target: Target, l1: float, ssim: float) -> Tensor:
        value, gradient = _native.photometric_loss(
            image.detach().contiguous(),
            target.image,
            target.mean,
            target.variance,
            l1,
            ssim,
            ctx.needs_input_grad[0],
            torch.get_num_threads(),
        )
        if gradient is not None:
            ctx.save_for_backward(gradient)
        return image.new_tensor(value)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, v_loss: Tensor) -> tuple[Tensor, None, None, None]:
        (gradient,) = ctx.saved_tensors
        # A loss that nothing multiplies spares a pass over the image.
        return gradient if v_loss == 1 else gradient * v_loss, None, None, None
