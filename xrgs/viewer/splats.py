"""Converts Gaussians for viewers in a browser: to positions, covariances and flat colours.

Such viewers sort and blend all Gaussians themselves, which is slow for more than some hundred
thousand, so that the least opaque ones can be left out.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray

from xrgs.splat.quaternions import rotation_matrices
from xrgs.splat.sh import sh_to_colors

if TYPE_CHECKING:
    from xrgs.splat.gaussians import Gaussians

Array = NDArray[np.float32]


@dataclass(frozen=True)
class Splats:
    """N Gaussians without harmonics above band 0, in the order of the model."""

    centers: Array
    """[N, 3] world units."""
    covariances: Array
    """[N, 3, 3] world units squared."""
    colors: Array
    """[N, 3] in 0..1."""
    opacities: Array
    """[N] in 0..1."""


@torch.no_grad()
def to_splats(gaussians: Gaussians, limit: int) -> Splats:
    """Convert the `limit` most opaque Gaussians of a model; of equal ones, the first are taken."""
    kept = gaussians.opacities.argsort(descending=True, stable=True)[:limit].sort().values
    rotations, scales = rotation_matrices(gaussians.quats[kept]), gaussians.scales[kept].exp()
    factor = rotations * scales[:, None, :]  # [N, 3, 3], each axis times its length
    means, sh0 = gaussians.means[kept], gaussians.sh0[kept]
    any_direction = torch.zeros_like(means)
    arrays = (
        means,
        factor @ factor.transpose(1, 2),
        sh_to_colors(0, any_direction, sh0, gaussians.shN[kept]).clamp(0, 1),
        gaussians.opacities[kept].sigmoid(),
    )
    return Splats(*(array.numpy() for array in arrays))
