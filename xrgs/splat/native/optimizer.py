"""Adam's step by the compiled kernel, on the state that `torch.optim.Adam` keeps."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from xrgs import _native

if TYPE_CHECKING:
    from xrgs.splat.cameras import Camera


def step(adam: torch.optim.Adam, camera: Camera | None = None, sh_degree: int = 0) -> None:
    """What `adam.step()` does, for all groups in one pass over memory.

    With a camera shN's gradient is made of sh0's as its moments are moved (`SplatOptimizer.step`):
    that of training is never written to memory.

    torch's own formula in torch's own order, one rounding fewer where a multiplication and an
    addition are fused: the two differ by rounding alone (`tests/splat/test_native_adam.py` says how
    much). Values whose gradient and moments are all zero, as of harmonics that aren't on yet, are
    not written. Bitwise the same for any number of threads.

    Args:
        adam: Named groups of one parameter each, float32 [N, ...] on the CPU, contiguous, with
            betas and eps in common and without weight decay; those without a gradient stay as
            they are.
        camera: The view that the gradients come from.
        sh_degree: Highest band that was on.

    Raises:
        ValueError: A parameter, gradient or moment isn't float32.
    """
    beta1, beta2 = adam.defaults["betas"]
    groups = {group["name"]: group for group in adam.param_groups}
    if camera is not None and groups["sh0"]["params"][0].grad is not None:
        _step_harmonics(adam, groups, camera, sh_degree)  # first: by the means as rendered
    entries = []
    for name, group in groups.items():
        (parameter,) = group["params"]
        if parameter.grad is None:
            continue
        state = _state(adam, parameter)
        state["step"] += 1
        tensors = (parameter, parameter.grad, state["exp_avg"], state["exp_avg_sq"])
        flat = [_plain(name, tensor).view(-1) for tensor in tensors]
        entries.append((*flat, group["lr"], state["step"].item()))
    _native.adam(entries, beta1, beta2, adam.defaults["eps"], torch.get_num_threads())


def _step_harmonics(
    adam: torch.optim.Adam, groups: dict[str, dict[str, Any]], camera: Camera, sh_degree: int
) -> None:
    means, sh0, shN = (groups[name]["params"][0] for name in ("means", "sh0", "shN"))
    beta1, beta2 = adam.defaults["betas"]
    state = _state(adam, shN)
    state["step"] += 1
    _native.adam_harmonics(
        _plain("shN", shN),
        _plain("shN", state["exp_avg"]),
        _plain("shN", state["exp_avg_sq"]),
        _plain("means", means),
        _plain("sh0", sh0.grad).view(-1, 3),
        camera.position.tolist(),
        sh_degree,
        groups["shN"]["lr"],
        state["step"].item(),
        beta1,
        beta2,
        adam.defaults["eps"],
        torch.get_num_threads(),
    )


def _state(adam: torch.optim.Adam, parameter: Tensor) -> dict[str, Tensor]:
    """Adam's state of a parameter, as torch starts it if there is none."""
    state: dict[str, Tensor] = adam.state[parameter]
    if not state:
        state["step"] = torch.zeros(())
        state["exp_avg"] = torch.zeros_like(parameter, memory_format=torch.preserve_format)
        state["exp_avg_sq"] = torch.zeros_like(parameter, memory_format=torch.preserve_format)
    return state


def _plain(name: str, value: Tensor) -> Tensor:
    if value.dtype != torch.float32 or value.device.type != "cpu" or not value.is_contiguous():
        raise ValueError(
            f"{name} and its gradient must be float32, contiguous, on the CPU for the native"
            f" optimizer, got {value.dtype} on {value.device}, strides {value.stride()}"
        )
    return value.detach()
