"""The scene: Gaussians as the raw parameters that the optimizer sees."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import KDTree
from torch import Tensor

from xrgs.splat.sh import bases, colors_to_sh0

PARAMETERS = ("means", "quats", "scales", "opacities", "sh0", "shN")

MIN_SPACING = 1e-7
"""World units; the smallest initial scale, for points that lie on one another (log 0 else)."""


class Activated(NamedTuple):
    """What `rasterize` takes: the Gaussians in their natural units, in `PARAMETERS`' order."""

    means: Tensor  # [N, 3] world units
    quats: Tensor  # [N, 4] wxyz, any length
    scales: Tensor  # [N, 3] world units
    opacities: Tensor  # [N] 0..1
    sh0: Tensor  # [N, 1, 3]
    shN: Tensor  # [N, K - 1, 3]  # noqa: N815 - the field's name


@dataclass
class Gaussians:
    """N Gaussians. Leaf tensors, on which gradients gather; also reached by name, as a dict's."""

    means: Tensor  # [N, 3] world units
    quats: Tensor  # [N, 4] wxyz, any length
    scales: Tensor  # [N, 3] natural log of world units
    opacities: Tensor  # [N] logit
    sh0: Tensor  # [N, 1, 3]
    shN: Tensor  # [N, K - 1, 3], K = (degree + 1)^2  # noqa: N815 - the field's name

    def __len__(self) -> int:
        return int(self.means.shape[0])

    def __getitem__(self, name: str) -> Tensor:
        if name not in PARAMETERS:
            raise KeyError(name)
        value: Tensor = getattr(self, name)
        return value

    def __setitem__(self, name: str, value: Tensor) -> None:
        if name not in PARAMETERS:
            raise KeyError(name)
        setattr(self, name, value)

    def activated(self) -> Activated:
        """Scales in world units, opacities in 0..1, the rest as it is.

        shN is cut off from its leaf: its gradient, three quarters of all, is never made. The
        optimizer has it from sh0's (`SplatOptimizer.step`).
        """
        return Activated(
            self.means,
            self.quats,
            torch.exp(self.scales),
            torch.sigmoid(self.opacities),
            self.sh0,
            self.shN.detach(),
        )


def from_points(
    points: Tensor | NDArray[np.float64],
    colors: Tensor | NDArray[np.uint8],
    *,
    init_opacity: float,
    sh_degree: int,
    generator: torch.Generator,
) -> Gaussians:
    """Gaussians on SfM points, as gsplat's `simple_trainer.py` starts.

    Isotropic, as large as the RMS distance to the three nearest neighbours; random quaternions;
    band 0 shows the point's colour, the rest is 0.

    Args:
        points: [P, 3] world units.
        colors: [P, 3], 8-bit, or floats in 0..1.
        init_opacity: between 0 and 1.
        sh_degree: highest band stored, 0 to 3.
        generator: draws the quaternions.

    Returns:
        P Gaussians, float32, with gradients on.

    Raises:
        ValueError: fewer than 4 points, shapes that do not fit, values that are not finite, or an
            opacity that has no logit.
    """
    means = torch.as_tensor(points, dtype=torch.float32)
    rgb = torch.as_tensor(colors)
    rgb = rgb.float() / 255.0 if rgb.dtype == torch.uint8 else rgb.float()
    count = means.shape[0]
    if means.ndim != 2 or means.shape[1] != 3 or rgb.shape != means.shape:
        raise ValueError(
            f"points and colors must both be [P, 3], got {list(means.shape)} and {list(rgb.shape)}"
        )
    if count < 4:
        raise ValueError(f"points: at least 4 are needed to know their spacing, got {count}")
    for name, values in (("points", means), ("colors", rgb)):
        if not torch.isfinite(values).all():
            raise ValueError(f"{name} has values that are not finite")
    if not 0.0 < init_opacity < 1.0:
        raise ValueError(f"init_opacity must be between 0 and 1, got {init_opacity}")

    log_spacing = torch.log(_spacing(means))  # [P]
    tensors = {
        "means": means.clone(),
        "quats": torch.rand((count, 4), generator=generator),
        "scales": log_spacing[:, None].repeat(1, 3),
        "opacities": torch.full((count,), math.log(init_opacity / (1 - init_opacity))),
        "sh0": colors_to_sh0(rgb),
        "shN": torch.zeros((count, bases(sh_degree) - 1, 3)),
    }
    return Gaussians(**{name: value.requires_grad_() for name, value in tensors.items()})


def _spacing(points: Tensor) -> Tensor:
    """RMS distance of each point [P, 3] to its three nearest neighbours: [P]."""
    distances, _ = KDTree(points.numpy()).query(points.numpy(), k=4)  # [P, 4], itself first
    squared = torch.from_numpy(distances[:, 1:]).square().mean(dim=-1)
    return squared.sqrt().float().clamp_min(MIN_SPACING)
