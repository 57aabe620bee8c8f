"""The activation functions and the densification statistics by the compiled kernels.

The activations have the same bits on every processor and for any number of threads; the last bits
of torch's functions differ.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from xrgs import _native
from xrgs.splat.native.arguments import contiguous_handle, handle, require_float32


def exp(x: Tensor) -> Tensor:
    """Return e^x: scales from their natural logarithms.

    The relative error is below 1.0e-7. A result below 2^-126 is 0, a result above the largest
    float is infinite, and NaN stays NaN. The result is contiguous, and once differentiable.

    Raises:
        ValueError: `x` is not float32 on the CPU.
    """
    require_float32("scales", x)
    y: Tensor = _Activation.apply(x, _native.exp, _native.exp_backward)
    return y


def logistic(x: Tensor) -> Tensor:
    """Return 1 / (1 + e^-x): opacities from their logits.

    The relative error is below 2.0e-7. Otherwise as `exp`.
    """
    require_float32("opacities", x)
    y: Tensor = _Activation.apply(x, _native.logistic, _native.logistic_backward)
    return y


_Forward = Callable[[Tensor, int], Tensor]
_Backward = Callable[[Tensor, Tensor, int], Tensor]


class _Activation(torch.autograd.Function):
    """An elementwise function whose derivative is computed from its value."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, forward: _Forward, backward: _Backward) -> Tensor:
        y = forward(x.detach().contiguous().view(-1), torch.get_num_threads()).view(x.shape)
        ctx.backward_kernel = backward
        ctx.save_for_backward(y)
        return y

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_y: Tensor) -> tuple[Tensor, None, None]:
        (y,) = ctx.saved_tensors
        flat = v_y.contiguous().view(-1), y.view(-1)
        return ctx.backward_kernel(*flat, torch.get_num_threads()).view(y.shape), None, None


def accumulate_statistics(
    means2d_grad: Tensor,
    visible: Tensor,
    half_size: tuple[float, float],
    grad2d_sum: Tensor,
    visible_count: Tensor,
) -> None:
    """Add a step's image-plane gradients as `accumulate_statistics` of `xrgs.splat.torch` does.

    Raises:
        ValueError: A tensor has the wrong type, shape or strides.
    """
    require_float32("means2d_grad", means2d_grad)
    if visible.dtype != torch.bool:
        raise ValueError(f"visible must be bool, got {visible.dtype}")
    _native.accumulate_grad2d(
        handle(means2d_grad.contiguous()),
        handle(visible.contiguous()),
        *half_size,
        contiguous_handle("grad2d_sum", grad2d_sum),
        contiguous_handle("visible_count", visible_count),
        torch.get_num_threads(),
    )
    # The kernel writes in place: autograd must refuse the old values.
    torch.autograd.graph.increment_version(grad2d_sum)
    torch.autograd.graph.increment_version(visible_count)
