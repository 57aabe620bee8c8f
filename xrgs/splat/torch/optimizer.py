"""Adam's step by `torch.optim.Adam` itself."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch.nn.functional import normalize

from xrgs.splat.sh import C0, sh_basis

if TYPE_CHECKING:
    from xrgs.splat.cameras import Camera


def step(adam: torch.optim.Adam, camera: Camera | None = None, sh_degree: int = 0) -> None:
    """Move every parameter that has a gradient.

    Args:
        adam: Named groups of one parameter each.
        camera: The view that the gradients come from; None leaves shN as it is, unless it has a
            gradient (`SplatOptimizer.step`).
        sh_degree: Highest band of the spherical harmonics that was rendered.
    """
    if camera is not None:
        _fill_harmonics_gradient(adam, camera, sh_degree)
    adam.step()


@torch.no_grad()
def _fill_harmonics_gradient(adam: torch.optim.Adam, camera: Camera, sh_degree: int) -> None:
    """Give shN the gradient that sh0's implies; nothing where sh0 has none."""
    parameters = {group["name"]: group["params"][0] for group in adam.param_groups}
    means, sh0, shN = (parameters[name] for name in ("means", "sh0", "shN"))
    if sh0.grad is not None:
        dirs = normalize(means - camera.position.to(means), dim=-1)  # [N, 3]
        basis = sh_basis(sh_degree, dirs)[:, 1:, None]  # [N, K - 1, 1]
        shN.grad = torch.zeros_like(shN)
        shN.grad[:, : basis.shape[1]] = basis * (sh0.grad / C0)
