"""Adam's step by the compiled kernel, on the state that `torch.optim.Adam` keeps."""

from __future__ import annotations

import torch
from torch import Tensor

from xrgs import _native


def step(adam: torch.optim.Adam) -> None:
    """What `adam.step()` does, for all groups in one pass over memory.

    torch's own formula in torch's own order, one rounding fewer where a multiplication and an
    addition are fused: the two differ by rounding alone (`tests/splat/test_native_adam.py` says how
    much). Values whose gradient and moments are all zero, as of harmonics that aren't on yet, are
    not written. Bitwise the same for any number of threads.

    Args:
        adam: Named groups of one parameter each, float32 [N, ...] on the CPU, contiguous, with
            betas and eps in common and without weight decay; those without a gradient stay as
            they are.

    Raises:
        ValueError: A parameter, gradient or moment isn't float32.
    """
    beta1, beta2 = adam.defaults["betas"]
    groups = []
    for group in adam.param_groups:
        (parameter,) = group["params"]
        if parameter.grad is None:
            continue
        state = _state(adam, parameter)
        state["step"] += 1
        tensors = (parameter, parameter.grad, state["exp_avg"], state["exp_avg_sq"])
        flat = [_flat(group["name"], tensor) for tensor in tensors]
        groups.append((*flat, group["lr"], state["step"].item()))
    _native.adam(groups, beta1, beta2, adam.defaults["eps"], torch.get_num_threads())


def _state(adam: torch.optim.Adam, parameter: Tensor) -> dict[str, Tensor]:
    """Adam's state of a parameter, as torch starts it if there is none."""
    state: dict[str, Tensor] = adam.state[parameter]
    if not state:
        state["step"] = torch.zeros(())
        state["exp_avg"] = torch.zeros_like(parameter, memory_format=torch.preserve_format)
        state["exp_avg_sq"] = torch.zeros_like(parameter, memory_format=torch.preserve_format)
    return state


def _flat(name: str, value: Tensor) -> Tensor:
    if value.dtype != torch.float32 or value.device.type != "cpu" or not value.is_contiguous():
        raise ValueError(
            f"{name} and its gradient must be float32, contiguous, on the CPU for the native"
            f" optimizer, got {value.dtype} on {value.device}, strides {value.stride()}"
        )
    return value.detach().view(-1)
