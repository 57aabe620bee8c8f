"""Adam's step by the compiled kernel, on the state that `torch.optim.Adam` keeps."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from xrgs import _native
from xrgs.splat.native.arguments import handle

if TYPE_CHECKING:
    from xrgs.splat.cameras import Camera


def step(adam: torch.optim.Adam, camera: Camera | None = None, sh_degree: int = 0) -> None:
    """Move every parameter that has a gradient, in one pass over memory.

    The formula is torch's, in torch's order, with one rounding fewer where a multiplication and an
    addition are fused (`tests/splat/native/test_optimizer.py` has the bounds). A value is not
    written if its gradient and moments are zero, as for harmonics that are not on yet. The result
    has the same bits for any number of threads.

    With a camera, the gradient of shN is computed from the gradient of sh0 as shN moves, and never
    written to memory.

    Args:
        adam: Named groups of one parameter each, float32 [N, ...] on the CPU, contiguous, with
            betas and eps in common and without weight decay. Parameters without a gradient stay as
            they are.
        camera: The view that the gradients come from; None leaves shN as it is, unless it has a
            gradient (`SplatOptimizer.step`).
        sh_degree: Highest band of the spherical harmonics that was rendered.

    Raises:
        ValueError: A parameter, gradient or moment is not float32 on the CPU and contiguous.
    """
    groups = {group["name"]: group for group in adam.param_groups}
    harmonics: tuple[Any, ...] | None = None
    moved: list[Tensor] = []
    if camera is not None and groups["sh0"]["params"][0].grad is not None:
        harmonics = _harmonics(adam, groups, camera, sh_degree)
        moved.append(groups["shN"]["params"][0])
    entries = []
    for name, group in groups.items():
        (parameter,) = group["params"]
        if parameter.grad is None:
            continue
        state = _adam_state(adam, parameter)
        changing = (parameter, state["exp_avg"], state["exp_avg_sq"])
        values, exp_avg, exp_avg_sq = (_plain_handle(name, tensor) for tensor in changing)
        gradient = _plain_handle(name, parameter.grad)
        number = state["step"].add_(1).item()
        entries.append((values, gradient, exp_avg, exp_avg_sq, group["lr"], number))
        moved.append(parameter)
    beta1, beta2 = adam.defaults["betas"]
    threads = torch.get_num_threads()
    _native.adam_step(entries, beta1, beta2, adam.defaults["eps"], threads, harmonics)
    # So that a backward pass refuses to use the values from before.
    for tensor in moved:
        torch.autograd.graph.increment_version(tensor)


def _harmonics(
    adam: torch.optim.Adam, groups: dict[str, dict[str, Any]], camera: Camera, sh_degree: int
) -> tuple[Any, ...]:
    """Return the argument that moves shN by the gradient that sh0's implies."""
    means, sh0, shN = (groups[name]["params"][0] for name in ("means", "sh0", "shN"))
    state = _adam_state(adam, shN)
    return (
        *(_plain_handle("shN", x) for x in (shN, state["exp_avg"], state["exp_avg_sq"])),
        _plain_handle("means", means),
        _plain_handle("sh0", sh0.grad),
        camera.numbers.position,
        sh_degree,
        groups["shN"]["lr"],
        state["step"].add_(1).item(),
    )


def _adam_state(adam: torch.optim.Adam, parameter: Tensor) -> dict[str, Tensor]:
    """Return Adam's state of a parameter, created as torch creates it if there is none."""
    state: dict[str, Tensor] = adam.state[parameter]
    if not state:
        state["step"] = torch.zeros(())
        state["exp_avg"] = torch.zeros_like(parameter, memory_format=torch.preserve_format)
        state["exp_avg_sq"] = torch.zeros_like(parameter, memory_format=torch.preserve_format)
    return state


def _plain_handle(name: str, value: Tensor) -> Any:
    """Return a tensor's handle; ValueError unless float32, contiguous, on the CPU."""
    if value.dtype != torch.float32 or value.device.type != "cpu" or not value.is_contiguous():
        raise ValueError(
            f"{name} and its gradient must be float32, contiguous, on the CPU for the native"
            f" optimizer, got {value.dtype} on {value.device}, strides {value.stride()}"
        )
    return handle(value)
