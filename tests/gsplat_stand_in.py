"""`gsplat_api.rasterization` in the place of `gsplat.rasterization`, for `splat.backend=gsplat`.

gsplat's kernels need a GPU. Ours have the signature and the constants of gsplat 1.5.3, which the
tests have installed.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import SimpleNamespace
from typing import Any

import gsplat
import pytest
import torch
from torch import Tensor

from xrgs.formats import gsplat_api
from xrgs.splat import backend

#: The setting that equals the constant of gsplat 1.5.3's kernels.
ALPHA_MAX = "splat.raster.alpha_max=0.999"


class _Means2d:
    """`means2d` of a stand-in on another device than the processor."""

    def __init__(self, means2d: Tensor, device: torch.device) -> None:
        self.means2d, self.device = means2d, device

    def retain_grad(self) -> None:
        self.means2d.retain_grad()

    @property
    def grad(self) -> Tensor | None:
        return None if self.means2d.grad is None else self.means2d.grad.to(self.device)

    @property
    def absgrad(self) -> Tensor:
        found: Tensor = self.means2d.absgrad  # type: ignore[attr-defined]
        return found.to(self.device)


def rasterization(**given: Any) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """`gsplat_api.rasterization` of tensors that are all on one device, the backend's."""
    tensors = {name: value for name, value in given.items() if isinstance(value, Tensor)}
    devices = {value.device for value in tensors.values()}
    assert {device.type for device in devices} == {backend.DEVICES["gsplat"]}, tensors
    (device,) = devices
    image, alpha, meta = gsplat_api.rasterization(
        **given | {name: value.cpu() for name, value in tensors.items()}
    )
    meta["radii"] = meta["radii"].to(device)
    meta["flatten_ids"] = torch.zeros(int((meta["radii"] > 0).sum()), device=device)
    if device.type != "cpu":
        meta["means2d"] = _Means2d(meta["means2d"], device)
    return image.to(device), alpha.to(device), meta


@contextmanager
def stand_in(device: str = "cpu", function: Callable[..., Any] = rasterization) -> Iterator[None]:
    """Let `splat.backend=gsplat` call `function`, with tensors on `device`."""
    module = "xrgs.splat.gsplat.rasterizer"
    backend._module.cache_clear()
    with pytest.MonkeyPatch.context() as patch:
        patch.delitem(sys.modules, module, raising=False)
        patch.setitem(backend.DEVICES, "gsplat", device)
        patch.setattr(gsplat, "rasterization", function)
        patch.setitem(sys.modules, "gsplat.cuda._backend", SimpleNamespace(_C="kernels"))
        yield
        sys.modules.pop(module, None)
    backend._module.cache_clear()
