"""The photometric loss by compiled kernels: value and gradient in one pass over the image."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from xrgs import _native
from xrgs.splat.loss import WEIGHTS, Target
from xrgs.splat.native.arguments import handle, require_float32

_WINDOW = torch.tensor(WEIGHTS, dtype=torch.float64, device="cpu")


def target_moments(image: Tensor) -> tuple[Tensor, Tensor]:
    """Compute `xrgs.splat.torch.loss.target_moments`, with the same bits for any thread count.

    Moments below 1.2e-38 are zero.
    """
    require_float32("image", image)
    moments: tuple[Tensor, Tensor] = _native.window_moments(
        handle(image), handle(_WINDOW), torch.get_num_threads()
    )
    return moments


def photometric_loss(
    image: Tensor, target: Target, l1: float, ssim: float, pixel_weight: Tensor | None
) -> Tensor:
    """Compute `xrgs.splat.loss.photometric_loss`, once differentiable with respect to the image.

    Sums are in double and in a fixed order: value and gradient have the same bits for any number of
    threads. A NaN in the image, the target or the weights makes the loss NaN, and the gradients of
    all pixels that share a window with it. Tensors may have any strides.
    """
    require_float32("image", image)
    require_float32("target", target.image)
    if pixel_weight is not None:
        require_float32("pixel_weight", pixel_weight)
        if pixel_weight.requires_grad:
            raise ValueError(
                "pixel_weight must not require a gradient: the native backend computes none for it"
            )
        pixel_weight = pixel_weight.contiguous()
    loss: Tensor = _Photometric.apply(image, target, l1, ssim, pixel_weight)
    return loss


class _Photometric(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        image: Tensor,
        target: Target,
        l1: float,
        ssim: float,
        pixel_weight: Tensor | None,
    ) -> Tensor:
        value, gradient = _native.photometric_loss(
            handle(image.contiguous()),
            handle(target.image),
            handle(target.mean),
            handle(target.variance),
            None if pixel_weight is None else handle(pixel_weight),
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
    def backward(ctx: Any, v_loss: Tensor) -> tuple[Tensor, None, None, None, None]:
        (gradient,) = ctx.saved_tensors
        # A factor of 1 needs no pass over the image.
        return gradient if v_loss.item() == 1 else gradient * v_loss, None, None, None, None
