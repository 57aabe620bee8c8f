"""Adam's step by the compiled kernel."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from xrgs import _native
from xrgs.splat.gaussians import PARAMETERS
from xrgs.splat.native.arguments import handle

if TYPE_CHECKING:
    from xrgs.splat.cameras import Camera
    from xrgs.splat.optimizer import SplatOptimizer


def step(optimizer: SplatOptimizer, camera: Camera | None = None, sh_degree: int = 0) -> None:
    """Move every parameter that has a gradient, in one pass over memory.

    The formula is torch's, in torch's order, with one rounding fewer where a multiplication and an
    addition are fused (`tests/splat/native/test_optimizer.py` has the bounds). A value is not
    written if its gradient and moments are zero, as for harmonics that are not on yet. The result
    has the same bits for any number of threads.

    With a camera, the gradient of shN is computed from the gradient of sh0 as shN moves, and never
    written to memory.

    Args:
        optimizer: The parameters with their gradients, and Adam's state of them, which is updated:
            float32 on the CPU, contiguous. Parameters without a gradient stay as they are.
        camera: The view that the gradients come from; None leaves shN as it is, unless it has a
            gradient (`SplatOptimizer.step`).
        sh_degree: Highest band of the spherical harmonics that was rendered.

    Raises:
        ValueError: A parameter, gradient or moment is not float32 on the CPU and contiguous.
    """
    harmonics: tuple[Any, ...] | None = None
    moved: list[Tensor] = []
    if camera is not None and (gradient := optimizer.gaussians.sh0.grad) is not None:
        harmonics = _harmonics(optimizer, gradient, camera, sh_degree)
        moved.append(optimizer.gaussians.shN)
    entries = []
    for name in PARAMETERS:
        parameter = optimizer.gaussians[name]
        if parameter.grad is None:
            continue
        exp_avg, exp_avg_sq, number = optimizer.adam_of(name)
        tensors = (parameter, parameter.grad, exp_avg, exp_avg_sq)
        handles = (_plain_handle(name, tensor) for tensor in tensors)
        entries.append((*handles, optimizer.rates[name], number.add_(1).item()))
        moved.append(parameter)
    settings, threads = optimizer.settings, torch.get_num_threads()
    _native.adam_step(entries, settings.beta1, settings.beta2, settings.eps, threads, harmonics)
    # So that a backward pass refuses to use the values from before.
    for tensor in moved:
        torch.autograd.graph.increment_version(tensor)


def _harmonics(
    optimizer: SplatOptimizer, gradient: Tensor, camera: Camera, sh_degree: int
) -> tuple[Any, ...]:
    """Return the argument that moves shN by what the gradient of sh0 implies."""
    gaussians = optimizer.gaussians
    exp_avg, exp_avg_sq, number = optimizer.adam_of("shN")
    return (
        *(_plain_handle("shN", x) for x in (gaussians.shN, exp_avg, exp_avg_sq)),
        _plain_handle("means", gaussians.means),
        _plain_handle("sh0", gradient),
        camera.numbers.position,
        sh_degree,
        optimizer.rates["shN"],
        number.add_(1).item(),
    )


def _plain_handle(name: str, value: Tensor) -> Any:
    """Return a tensor's handle; ValueError unless float32, contiguous, on the CPU."""
    if value.dtype != torch.float32 or value.device.type != "cpu" or not value.is_contiguous():
        raise ValueError(
            f"{name} and its gradient must be float32, contiguous, on the CPU for the native"
            f" optimizer, got {value.dtype} on {value.device}, strides {value.stride()}"
        )
    return handle(value)
