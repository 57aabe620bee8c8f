"""View-dependent colour: real spherical harmonics of degree 0 to 3.

The basis is that of 3D Gaussian Splatting, of gsplat (`_spherical_harmonics` of
`cuda/_torch_impl.py`) and of viewers of .ply files: orthonormal, with the Condon-Shortley phase,
indexed l^2 + l + m. A colour is the sum over bands plus 0.5, clamped at 0.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

MAX_DEGREE = 3
"""Highest implemented degree."""
C0 = 0.5 / math.sqrt(math.pi)
"""The constant basis function of band 0."""


def bases(degree: int) -> int:
    """Return the number of basis functions of degree 0 to `degree`."""
    return (degree + 1) ** 2


def check_degree(degree: int) -> None:
    """Raise ValueError unless `degree` is 0 to 3."""
    if not 0 <= degree <= MAX_DEGREE:
        raise ValueError(f"sh_degree must be 0 to {MAX_DEGREE}, got {degree}")


def check_sh_degree(degree: int, shN: Tensor) -> None:
    """Check that the stored coefficients [N, K - 1, 3] suffice for a degree.

    Raises:
        ValueError: The degree is not 0 to 3, or shN has fewer bands than it needs or more than
            degree 3 has.
    """
    check_degree(degree)
    rest, most = bases(degree) - 1, bases(MAX_DEGREE) - 1
    if shN.shape[1] < rest:
        raise ValueError(f"sh_degree {degree} needs shN of [N, {rest}, 3], got {list(shN.shape)}")
    if shN.shape[1] > most:
        raise ValueError(
            f"shN must be [N, K - 1, 3] with K - 1 of at most {most}, got {list(shN.shape)}"
        )


def sh_basis(degree: int, dirs: Tensor) -> Tensor:
    """Evaluate the real spherical harmonics of degree 0 to `degree`, at most 3.

    Args:
        degree: Highest degree.
        dirs: [..., 3] directions of unit length.

    Returns:
        [..., (degree + 1)^2]
    """
    check_degree(degree)
    x, y, z = dirs.unbind(-1)
    basis = [torch.full_like(x, C0)]
    if degree >= 1:
        c1 = math.sqrt(3 / (4 * math.pi))
        basis += [-c1 * y, c1 * z, -c1 * x]
    if degree >= 2:
        c2 = math.sqrt(15 / (4 * math.pi))
        basis += [
            c2 * x * y,
            -c2 * y * z,
            math.sqrt(5 / (16 * math.pi)) * (3 * z * z - 1),
            -c2 * x * z,
            c2 / 2 * (x * x - y * y),
        ]
    if degree >= 3:
        c31 = math.sqrt(21 / (32 * math.pi))
        c32 = math.sqrt(105 / (4 * math.pi))
        c33 = math.sqrt(35 / (32 * math.pi))
        basis += [
            -c33 * y * (3 * x * x - y * y),
            c32 * x * y * z,
            -c31 * y * (5 * z * z - 1),
            math.sqrt(7 / (16 * math.pi)) * z * (5 * z * z - 3),
            -c31 * x * (5 * z * z - 1),
            c32 / 2 * z * (x * x - y * y),
            -c33 * x * (x * x - 3 * y * y),
        ]
    return torch.stack(basis, dim=-1)


def sh_to_colors(degree: int, dirs: Tensor, sh0: Tensor, shN: Tensor) -> Tensor:
    """Return the colours of Gaussians seen along given directions.

    Args:
        degree: Highest band that is on; higher stored bands are ignored.
        dirs: [N, 3] from the camera to each Gaussian, of unit length.
        sh0: [N, 1, 3] coefficients of band 0.
        shN: [N, K - 1, 3] coefficients of the higher bands, K >= (degree + 1)^2.

    Returns:
        [N, 3], at least 0, not clamped at 1.

    Raises:
        ValueError: As for `check_sh_degree`.
    """
    check_sh_degree(degree, shN)
    rest = bases(degree) - 1
    basis = sh_basis(degree, dirs)  # [N, (degree + 1)^2]
    colors = basis[:, :1] * sh0[:, 0]  # [N, 3]
    # Also at degree 0, so that shN has a gradient (0) and its Adam steps count, as in gsplat.
    colors = colors + torch.einsum("nk,nkc->nc", basis[:, 1:], shN[:, :rest])
    return (colors + 0.5).clamp_min(0.0)


def colors_to_sh0(colors: Tensor) -> Tensor:
    """Return the band 0 coefficients [N, 1, 3] of colours [N, 3] that every view shows."""
    return ((colors - 0.5) / C0)[:, None]
