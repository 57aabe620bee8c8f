"""What replaces the Gaussians that grow."""

from __future__ import annotations

import math
from collections.abc import Mapping

import torch
from torch import Tensor

from xrgs.splat.quaternions import rotation_matrices

SPLIT_SHRINK = 1.6
"""The scales of a Gaussian split at random are divided by this in its two halves [kerbl2023,
section 5.2]."""


def split_at_random(
    old: Mapping[str, Tensor], scales: Tensor, generator: torch.Generator
) -> dict[str, Tensor]:
    """Return two smaller Gaussians for each, their means drawn from it (gsplat's `split`).

    Args:
        old: Raw parameters [M, ...] for each name of `PARAMETERS`.
        scales: [M, 3] their scales, world units.
        generator: Draws the means.

    Returns:
        Raw parameters [2 M, ...]: the first of each pair, then the second.
    """
    # In double, since the numbers that torch draws in float32 depend on the processor.
    noise = torch.randn(2, len(scales), 3, generator=generator, dtype=torch.float64)
    along_axes = (noise.to(scales) * scales)[..., None, :]  # [2, M, 1, 3]
    # [2, M, 3] each; added one by one, in an order that does not depend on the processor.
    first, second, third = (rotation_matrices(old["quats"]) * along_axes).unbind(-1)
    offsets = first + second + third
    halves = {name: torch.cat([value, value]) for name, value in old.items()}
    halves["means"] = (old["means"] + offsets).reshape(-1, 3)
    halves["scales"] = (old["scales"] - math.log(SPLIT_SHRINK)).repeat(2, 1)
    return halves
