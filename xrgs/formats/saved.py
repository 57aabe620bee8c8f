"""The result of reading a file of Gaussians, and checks for all formats."""

from __future__ import annotations

import math
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from xrgs.errors import XrgsError
from xrgs.splat.gaussians import PARAMETERS, Gaussians

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
