"""What the formats of files of Gaussians share: the result of reading one, and its checks."""

from __future__ import annotations

import math
import shlex
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch

from xrgs.errors import XrgsError
from xrgs.splat.gaussians import PARAMETERS, Gaussians

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from numpy.typing import NDArray
    from torch import Tensor

CERTAIN_LOGIT = 100.0
"""Stands for an infinite logit: float32 rounds the opacity to 1, and to less than 1e-43."""
FLAT_LOG_SCALE = -40.0
"""Stands for the logarithm of a scale of 0; the square of the scale is still a normal float32."""
#: Formats of others by the ends of their files' names.
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
    """Whether the file says that they were trained with the 2D filter of Mip-Splatting, so that
    they are to be rendered with `RasterSettings(antialiased=True)`."""


def check_finite(path: Path, table: NDArray[Any], names: Sequence[str]) -> None:
    """Raise XrgsError for a value of a table [N, C] that is not finite; the columns have names."""
    if not np.isfinite(table).all():
        row, column = np.argwhere(~np.isfinite(table))[0]
        raise XrgsError(
            f"{path}: {names[column]} of Gaussian {row} (from 0) is {table[row, column]}; "
            "it must be finite"
        )


def check_arrays_finite(path: Path, arrays: Mapping[str, NDArray[Any]]) -> None:
    """Raise XrgsError for a value of arrays [N, ...] by their names that is not finite."""
    for name, values in arrays.items():
        width = math.prod(values.shape[1:])
        check_finite(path, values.reshape(len(values), width), [name] * width)


def unit_quaternions(quats: Tensor) -> NDArray[np.float64]:
    """Return quaternions [N, 4] wxyz of length 1, which other programs expect in files.

    float64 holds the squares of all float32. A quaternion of zeros becomes the identity, as it is
    rendered; one with a value that is not finite becomes NaN.
    """
    values = quats.detach().double().numpy()
    with np.errstate(invalid="ignore"):
        length = np.linalg.norm(values, axis=1, keepdims=True)
        unit = values / np.where(length == 0, 1.0, length)
    return np.where(length == 0, [1.0, 0, 0, 0], unit)


def to_gaussians(values: Mapping[str, NDArray[Any]]) -> Gaussians:
    """Return float32 leaf tensors with gradients on, from arrays by the names of parameters."""
    tensors = {
        name: torch.from_numpy(np.array(values[name], np.float32, order="C")) for name in PARAMETERS
    }
    return Gaussians(**{name: value.requires_grad_() for name, value in tensors.items()})


def check_is_read(path: Path) -> None:
    """Raise XrgsError for a file in a format that is known and not read, by its name."""
    for end, whose in _NOT_READ.items():
        if path.name.lower().endswith(end):
            raise XrgsError(f"{path}: {whose} format is not read; {converted_by(path)}")


def converted_by(path: Path) -> str:
    """Return the end of a message about a format that is not read: the command that converts it."""
    result = path.with_suffix(".ply")
    if result == path:
        result = path.with_name(f"{path.stem.removesuffix('.compressed')}-plain.ply")
    command = ["npx", "@playcanvas/splat-transform", str(path), str(result)]
    return f"convert it: {shlex.join(command)}"
