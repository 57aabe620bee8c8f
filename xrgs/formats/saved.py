"""The result of reading a file of Gaussians; checks and transforms for all formats."""

from __future__ import annotations

import math
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from torch import Tensor

from xrgs.errors import XrgsError
from xrgs.splat.gaussians import PARAMETERS, Gaussians
from xrgs.splat.sh import bases, sh_basis

CERTAIN_LOGIT = 100.0
"""Replaces an infinite logit, up to sign: in float32 the opacity becomes 1, or less than 1e-43."""
FLAT_LOG_SCALE = -40.0
"""Replaces the logarithm of a scale of 0; the square of this scale is still a normal float32."""
#: End of a file's name -> format that is not supported.
_NOT_READ = {
    ".splat": "antimatter15's",
    ".ksplat": "mkkellogg's",
    ".sog": "PlayCanvas's",
    "meta.json": "PlayCanvas's SOG",
    ".lcc": "XGRIDS's",
}
#: Relative tolerance for the axes of a similarity to be perpendicular and of equal length.
_TOLERANCE = 1e-4


class SavedGaussians(NamedTuple):
    """The content of a file of Gaussians."""

    gaussians: Gaussians
    antialiased: bool
    """Whether, according to the file, the Gaussians were trained with the 2D filter of
    Mip-Splatting. If so, render them with `RasterSettings(antialiased=True)`."""


def check_finite(path: Path, table: NDArray[Any], names: Sequence[str]) -> None:
    """Raise XrgsError if a table [N, C] has a value that is not finite; `names` are the columns."""
    if not np.isfinite(table).all():
        row, column = np.argwhere(~np.isfinite(table))[0]
        raise XrgsError(
            f"{path}: {names[column]} of Gaussian {row} (from 0) is {table[row, column]}; "
            "it must be finite"
        )


def check_arrays_finite(path: Path, arrays: Mapping[str, NDArray[Any]]) -> None:
    """Raise XrgsError if one of the arrays (name -> [N, ...]) has a value that is not finite."""
    for name, values in arrays.items():
        width = math.prod(values.shape[1:])
        check_finite(path, values.reshape(len(values), width), [name] * width)


def unit_quaternions(quats: Tensor) -> NDArray[np.float64]:
    """Return quaternions [N, 4] wxyz normalised to length 1, as other programs expect.

    float64 can represent the square of any float32. A zero quaternion becomes the identity, as in
    rendering; a quaternion with a value that is not finite becomes NaN.
    """
    values = quats.detach().double().numpy()
    with np.errstate(invalid="ignore"):
        length = np.linalg.norm(values, axis=1, keepdims=True)
        unit = values / np.where(length == 0, 1.0, length)
    return np.where(length == 0, [1.0, 0, 0, 0], unit)


def to_gaussians(values: Mapping[str, NDArray[Any]]) -> Gaussians:
    """Convert parameter name -> array to Gaussians: float32 leaf tensors that require gradients."""
    tensors = {
        name: torch.from_numpy(np.array(values[name], np.float32, order="C")) for name in PARAMETERS
    }
    return Gaussians(**{name: value.requires_grad_() for name, value in tensors.items()})


def check_is_read(path: Path) -> None:
    """Raise XrgsError if the file's name is that of an unsupported format."""
    for end, whose in _NOT_READ.items():
        if path.name.lower().endswith(end):
            raise XrgsError(f"{path}: {whose} format is not read; {converted_by(path)}")


def converted_by(path: Path) -> str:
    """Return the end of an error message: the command that converts an unsupported format."""
    result = path.with_suffix(".ply")
    if result == path:
        result = path.with_name(f"{path.stem.removesuffix('.compressed')}-plain.ply")
    command = ["npx", "@playcanvas/splat-transform", str(path), str(result)]
    return f"convert it: {shlex.join(command)}"


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
