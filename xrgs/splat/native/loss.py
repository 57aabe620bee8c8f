"""The photometric loss by the compiled kernel: value and gradient in one pass over the image."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from xrgs import _native

if TYPE_CHECKING:
    from xrgs.splat.loss import Target


def photometric_loss(image: Tensor, target: Target, l1: float, ssim: float) -> Tensor:
    """`xrgs.splat.loss.photometric_loss` of a float32 image on the CPU, once differentiable.

    Sums are kept in double and added in a fixed order: value and gradient are bitwise the same for
    any number of threads. Where the image or its target is NaN, so are the loss and the gradient
    under the windows that see it.

    Args:
        image: [H, W, 3] render, of any strides.
        target: Of the same shape.
        l1: Weight of the absolute difference.
        ssim: Weight of the structural dissimilarity.

    Returns:
        A scalar.

    Raises:
        ValueError: `image` or `target` isn't float32 on the CPU.
    """
    for name, value in (("image", image), ("target", target.image)):
        if value.dtype != torch.float32 or value.device.type != "cpu":
            raise ValueError(
                f"{name} must be float32 on the CPU for the native loss, got {value.dtype} on"
                f" {value.device}"
            )
    loss: Tensor = _Photometric.apply(image, target, l1, ssim)
    return loss


class _Photometric(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, image: Tensor, target: Target, l1: float, ssim: float) -> Tensor:
        value, gradient = _native.photometric(
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
    def backward(ctx: Any, slope: Tensor) -> tuple[Tensor, None, None, None]:
        (gradient,) = ctx.saved_tensors
        # A loss that nothing multiplies spares a pass over the image.
        return gradient if slope == 1 else gradient * slope, None, None, None
