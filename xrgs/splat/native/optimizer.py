"""Adam's step by the compiled kernel."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from xrgs import _native
from xrgs.splat.gaussians import PARAMETERS
from xrgs.splat.native.arguments import contiguous_handle

if TYPE_CHECKING:
    from xrgs.splat.cameras import Camera
    from xrgs.splat.optimizer import SplatOptimizer


def step(optimizer: SplatOptimizer, camera: Camera | None = None, sh_degree: int = 0) -> None:
    """Take Adam's step as `xrgs.splat.torch.optimizer.step` does, in one pass over memory.

    The formula and its order are torch's; a fused multiply-add rounds once instead of twice
    (`tests/splat/native/test_optimizer.py` has the bounds). A value whose gradient and moments are
    zero, as of harmonics that are not on yet, is not written. The result has the same bits for any
    number of threads. With a camera, the gradient of shN is never written to memory.
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
        tensors = {name: parameter, f"the gradient of {name}": parameter.grad}
        tensors |= {"exp_avg": exp_avg, "exp_avg_sq": exp_avg_sq}
        handles = (contiguous_handle(*named) for named in tensors.items())
        entries.append((*handles, optimizer.rates[name], number.add_(1).item()))
        moved.append(parameter)
    settings, threads = optimizer.settings, torch.get_num_threads()
    _native.adam_step(entries, settings.beta1, settings.beta2, settings.eps, threads, harmonics)
    # The kernel writes in place: autograd must refuse the old values.
    for tensor in moved:
        torch.autograd.graph.increment_version(tensor)


def _harmonics(
    optimizer: SplatOptimizer, gradient: Tensor, camera: Camera, sh_degree: int
) -> tuple[Any, ...]:
    """Return the kernel's argument for deriving the gradient of shN from that of sh0."""
    gaussians = optimizer.gaussians
    exp_avg, exp_avg_sq, number = optimizer.adam_of("shN")
    return (
        *(contiguous_handle("shN", x) for x in (gaussians.shN, exp_avg, exp_avg_sq)),
        contiguous_handle("means", gaussians.means),
        contiguous_handle("the gradient of sh0", gradient),
        camera.numbers.position,
        sh_degree,
        optimizer.rates["shN"],
        number.add_(1).item(),
    )
