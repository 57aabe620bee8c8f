"""Gaussians as .ply files in the layout of INRIA, which viewers of 3D Gaussian Splatting open.

A file has one vertex for each Gaussian with its raw parameters (logit opacities, log scales). The
harmonics above band 0 are stored by channel: all coefficients of red, then green, then blue.
"""

from __future__ import annotations

import logging
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from xrgs.errors import XrgsError
from xrgs.formats.saved import (
    CERTAIN_LOGIT,
    FLAT_LOG_SCALE,
    SavedGaussians,
    check_finite,
    check_is_read,
    converted_by,
    to_gaussians,
    unit_quaternions,
)
from xrgs.safeio import ply
from xrgs.safeio.atomic import atomic_writer
from xrgs.splat.sh import MAX_DEGREE, bases
from xrgs.splat.torch_defaults import on_cpu_in_float32

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from xrgs.splat.gaussians import Gaussians

    Table = NDArray[np.float32]

_log = logging.getLogger(__name__)

_NORMALS = ("nx", "ny", "nz")
ANTIALIASED_LINE = b"comment SplatRenderMode: mip\n"
"""The line of Brush and of SuperSplat's converter for antialiased Gaussians."""
#: How comments say it, in lower case: `SplatRenderMode: mip`, or Postshot's `antialiased 1`.
_RENDER_MODE = re.compile(r"splatrendermode:\s*(\S+)|antialiased\s+([01])")
#: Harmonics of more bands are in no file that a trainer writes.
_HIGHEST = 16


@on_cpu_in_float32
def save_ply(
    path: str | Path,
    gaussians: Gaussians,
    *,
    antialiased: bool = False,
    durable: bool = True,
    exact: bool = False,
) -> None:
    """Write Gaussians to a .ply file, which is replaced atomically.

    Args:
        path: The file to write.
        gaussians: The N Gaussians; they are written as little-endian float32, in raw parameters
            (logarithms of scales, logits of opacities) and unit quaternions.
        antialiased: Whether they were trained with `RasterSettings.antialiased`. The header then
            has the comment `SplatRenderMode: mip`, by which viewers know how to draw them.
        durable: Whether to wait until the content and the name are on the disk.
        exact: Whether quaternions keep their length, so that the file has every bit of the
            Gaussians. Some programs turn Gaussians whose quaternions are no unit ones.

    Raises:
        OSError: The file can't be written.

    Examples:
        >>> save_ply("splats.ply", gaussians)
    """
    path = Path(path) if isinstance(path, str) else path
    unit = torch.from_numpy(unit_quaternions(gaussians.quats))
    columns = [
        gaussians.means,
        torch.zeros_like(gaussians.means),  # normals, which viewers expect and do not use
        gaussians.sh0[:, 0],
        gaussians.shN.transpose(1, 2).flatten(1),
        gaussians.opacities[:, None],
        gaussians.scales,
        gaussians.quats if exact else unit,
    ]
    table = torch.cat([column.detach().float() for column in columns], dim=1)
    header = [
        f"element vertex {len(gaussians)}",
        *(f"property float {name}" for name in _properties(gaussians.shN.shape[1])),
        "end_header",
    ]
    with atomic_writer(path, durable=durable) as file:
        file.write(b"ply\nformat binary_little_endian 1.0\n")
        file.write(ANTIALIASED_LINE if antialiased else b"")
        file.write("".join(f"{line}\n" for line in header).encode())
        file.write(table.numpy().astype("<f4").tobytes())


@on_cpu_in_float32
def load_ply(path: str | Path) -> Gaussians:
    """Read Gaussians that `save_ply`, or any 3D Gaussian Splatting trainer, wrote.

    Properties may come in any order and of any type, among others, in text or binary. Bands of the
    harmonics above 3 are left out, with a warning. An infinite logit of an opacity and a
    logarithm of a scale of -inf become finite values that render the same. The filter of
    Mip-Splatting (`filter_3D`) is applied to the scales and opacities.

    Args:
        path: The .ply file.

    Returns:
        float32 leaf tensors with gradients on. A warning says that they are antialiased where the
        file does; `load_gaussians` returns it.

    Raises:
        XrgsError: The file is missing, damaged or no such .ply; the message names it.

    Examples:
        >>> gaussians = load_ply("splats.ply")
        >>> gaussians.means.requires_grad
        True
    """
    path = Path(path) if isinstance(path, str) else path
    gaussians, antialiased = read_ply(path)
    if antialiased:
        _log.warning(
            "%s says that its Gaussians are antialiased: render them with "
            "RasterSettings(antialiased=True). xrgs.load_gaussians returns this, without a warning",
            path,
        )
    return gaussians


def read_ply(path: Path) -> SavedGaussians:
    """Read Gaussians as `load_ply` does, and whether they are to be rendered antialiased."""
    check_is_read(path)
    file = ply.read(path)
    names = _columns(path, file.names)
    table = file.columns(names, np.float32)
    opacities, scales = table[:, -8], table[:, -7:-4]
    opacities[np.isposinf(opacities)] = CERTAIN_LOGIT
    opacities[np.isneginf(opacities)] = -CERTAIN_LOGIT
    scales[np.isneginf(scales)] = FLAT_LOG_SCALE
    antialiased = _is_antialiased(file.comments)
    if "filter_3D" in file.names:
        _log.warning("%s: the 3D filter of Mip-Splatting (filter_3D) is applied", path)
        sizes = file.columns(["filter_3D"], np.float64)
        check_finite(path, sizes, ["filter_3D"])
        scales[:], opacities[:] = _filtered(scales, opacities, sizes)
        antialiased = True  # Mip-Splatting renders so
    check_finite(path, table, names)
    values = {
        "means": table[:, :3],
        "sh0": table[:, None, 3:6],
        # By channel in the file, and by band in memory.
        "shN": table[:, 6:-8].reshape(len(table), 3, (len(names) - 14) // 3).swapaxes(1, 2),
        "opacities": opacities,
        "scales": scales,
        "quats": table[:, -4:],
    }
    return SavedGaussians(to_gaussians(values), antialiased)


def _is_antialiased(comments: Sequence[str]) -> bool:
    found = [match for text in comments if (match := _RENDER_MODE.fullmatch(text.lower()))]
    return bool(found) and (found[-1][1] == "mip" or found[-1][2] == "1")


def _properties(rest: int) -> list[str]:
    """Return a vertex's columns, with `rest` SH coefficients above band 0 for each channel."""
    return [
        *("x", "y", "z"),
        *_NORMALS,
        *(f"f_dc_{i}" for i in range(3)),
        *(f"f_rest_{i}" for i in range(3 * rest)),
        "opacity",
        *(f"scale_{i}" for i in range(3)),
        *(f"rot_{i}" for i in range(4)),
    ]


def _columns(path: Path, names: Sequence[str]) -> list[str]:
    """Return the properties that hold the parameters, in the order of `_properties`.

    Raises:
        XrgsError: Some are missing; the message says what the file seems to be instead.
    """
    if "packed_position" in names:
        raise XrgsError(
            f"{path}: a compressed .ply of SuperSplat, which is not read; {converted_by(path)}"
        )
    rest = sum(re.fullmatch(r"f_rest_[0-9]+", name) is not None for name in names)
    degree = next((d for d in range(_HIGHEST) if 3 * (bases(d) - 1) == rest), None)
    if degree is None:
        raise XrgsError(f"{path}: {rest} f_rest properties are not a whole number of SH bands")
    required = [name for name in _properties(rest // 3) if name not in _NORMALS]
    missing = [name for name in required if name not in names]
    if missing == ["scale_2"]:
        raise XrgsError(
            f"{path}: has no scale_2: these are the flat Gaussians of 2D Gaussian Splatting, "
            "which is not served"
        )
    if missing:
        kind = "" if "opacity" in names else "a point cloud and no Gaussians: "
        raise XrgsError(f"{path}: {kind}properties are missing: {', '.join(missing)}")
    if degree > MAX_DEGREE:
        _log.warning(
            "%s: has spherical harmonics of degree %d; bands above %d are left out",
            *(path, degree, MAX_DEGREE),
        )
        kept = bases(MAX_DEGREE) - 1
        left_out = {
            f"f_rest_{channel * rest // 3 + k}"
            for channel in range(3)
            for k in range(kept, rest // 3)
        }
        required = [name for name in required if name not in left_out]
    return required


def _filtered(scales: Table, opacities: Table, sizes: NDArray[np.float64]) -> tuple[Any, Any]:
    """Convolve Gaussians with isotropic ones of standard deviation `sizes` [N, 1], as in training.

    `xrgs.training.components.mip` has the formula.
    """
    with np.errstate(over="ignore", invalid="ignore"):  # what is not finite is refused later
        variances = np.exp(2 * scales.astype(np.float64))
        filtered = variances + sizes**2
        alpha = 1 / (1 + np.exp(-opacities.astype(np.float64)))
        alpha *= np.sqrt(variances / filtered).prod(axis=1)
    bounds = np.finfo(np.float32)
    alpha = alpha.clip(bounds.tiny, 1 - bounds.eps)
    return np.log(filtered) / 2, np.log(alpha / (1 - alpha))
