"""The activation functions of the raw parameters by the compiled kernels.

The results have the same bits on every processor and for any number of threads; the last bits of
torch's functions differ.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from xrgs import _native
from xrgs.splat.native.arguments import require_float32


def exp(x: Tensor) -> Tensor:
    """Return e^x: scales from their natural logarithms.

    The relative error is below 1.0e-7. A result below 2^-126 is 0, a result above the largest
    float is infinite, and NaN stays NaN. The result is contiguous, and once differentiable.

    Raises:
        ValueError: `x` is not float32 on the CPU.
    """
    return _activate(x, _native.exp, _native.exp_backward)


def logistic(x: Tensor) -> Tensor:
    """Return 1 / (1 + e^-x): opacities from their logits.

    The relative error is below 2.0e-7. Otherwise as `exp`.
    """
    return _activate(x, _native.logistic, _native.logistic_backward)


def activate(scales: Tensor, opacities: Tensor) -> tuple[Tensor, Tensor]:
    """Return `exp(scales)` and `logistic(opacities)`, in one node of the graph."""
    require_float32("scales", scales)
    require_float32("opacities", opacities)
    activated: tuple[Tensor, Tensor] = _ScalesAndOpacities.apply(scales, opacities)
    return activated


class _ScalesAndOpacities(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, scales: Tensor, opacities: Tensor) -> tuple[Tensor, Tensor]:
        ctx.set_materialize_grads(False)  # None, not zeros: Adam then skips the parameter
        threads = torch.get_num_threads()
        exp = _native.exp(scales.detach().reshape(-1), threads).view(scales.shape)
        logistic = _native.logistic(opacities.detach().contiguous(), threads)
        ctx.save_for_backward(exp, logistic)
        return exp, logistic

    @staticmethod
    @once_differentiable
    def backward(
        ctx: Any, v_exp: Tensor | None, v_logistic: Tensor | None
    ) -> tuple[Tensor | None, Tensor | None]:
        exp, logistic = ctx.saved_tensors
        threads = torch.get_num_threads()
        v_scales = v_opacities = None
        if v_exp is not None:
            flat = _native.exp_backward(v_exp.reshape(-1), exp.view(-1), threads)
            v_scales = flat.view(exp.shape)
        if v_logistic is not None:
            v_opacities = _native.logistic_backward(v_logistic.contiguous(), logistic, threads)
        return v_scales, v_opacities


_Forward = Callable[[Tensor, int], Tensor]
_Backward = Callable[[Tensor, Tensor, int], Tensor]


def _activate(x: Tensor, forward: _Forward, backward: _Backward) -> Tensor:
    require_float32("x", x)
    y: Tensor = _Activation.apply(x, forward, backward)
    return y


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
