"""Transforms Gaussians by a similarity: rotation, scale and translation."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from torch import Tensor

from xrgs.formats.saved import unit_quaternions
from xrgs.splat.gaussians import Gaussians
from xrgs.splat.sh import bases, sh_basis

#: Relative tolerance for the axes of a similarity to be perpendicular and of equal length.
_TOLERANCE = 1e-4


def transformed(gaussians: Gaussians, similarity: NDArray[np.float64]) -> Gaussians:
    """Transform Gaussians to another world, so that transformed cameras see the same image.

    `similarity` [4, 4] is from the old world to the new one: a rotation, which may mirror, times a
    scale above 0, and a translation; ValueError for any other matrix. The result is computed in
    float64: float32 leaf tensors that require gradients, with unit quaternions.
    """
    linear = similarity[:3, :3]
    determinant = float(np.linalg.det(linear)) if np.isfinite(similarity).all() else 0.0
    if determinant == 0:
        raise ValueError("must be finite, a rotation times a scale above 0")
    if not np.allclose(similarity[3], [0, 0, 0, 1], rtol=0, atol=_TOLERANCE):
        raise ValueError("must have 0, 0, 0, 1 as its last row; is it transposed?")
    scale = np.cbrt(abs(determinant))
    rotation = linear / scale
    if not np.allclose(rotation @ rotation.T, np.eye(3), rtol=0, atol=_TOLERANCE):
        raise ValueError("must be a rotation times one scale for all axes, without shear")
    # A mirror changes an ellipsoid in the same way as its negative, which is a rotation.
    proper = Rotation.from_matrix(rotation * np.sign(determinant))
    values = {
        "means": gaussians.means.detach().double() @ torch.from_numpy(linear.T.copy())
        + torch.from_numpy(similarity[:3, 3].copy()),
        "quats": _product(proper, torch.from_numpy(unit_quaternions(gaussians.quats))),
        "scales": gaussians.scales.detach().double() + float(np.log(scale)),
        "opacities": gaussians.opacities.detach(),
        "sh0": gaussians.sh0.detach(),
        "shN": _turned_harmonics(gaussians.shN.detach().double(), torch.from_numpy(rotation)),
    }
    return Gaussians(**{name: x.float().clone().requires_grad_() for name, x in values.items()})


def _product(turn: Rotation, quats: Tensor) -> Tensor:
    """Return the quaternions [N, 4] wxyz of first the rotations `quats`, then `turn`."""
    x, y, z, w = (float(value) for value in turn.as_quat())
    matrix = [[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]]
    return quats @ torch.tensor(matrix, dtype=torch.float64).T


def _turned_harmonics(coefficients: Tensor, turn: Tensor) -> Tensor:
    """Rotate or mirror harmonics: return coefficients [N, K - 1, 3] of f' with f'(turn d) = f(d).

    A rotation or mirror mixes only the harmonics within a band. The mixing matrix is solved for
    from the values of the harmonics at more directions than there are harmonics.
    """
    degree = round((coefficients.shape[1] + 1) ** 0.5) - 1
    dirs = torch.randn((64, 3), generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    dirs /= dirs.norm(dim=1, keepdim=True)
    before, after = sh_basis(degree, dirs @ turn), sh_basis(degree, dirs)  # [64, K]
    turned = torch.zeros_like(coefficients)
    for band in range(1, degree + 1):
        columns = slice(bases(band - 1), bases(band))
        mixing = torch.linalg.lstsq(after[:, columns], before[:, columns]).solution  # [2l+1, 2l+1]
        rest = slice(columns.start - 1, columns.stop - 1)
        turned[:, rest] = torch.einsum("jk,nkc->njc", mixing, coefficients[:, rest])
    return turned
