"""Gaussians as .ply files with INRIA's layout, for viewers of 3D Gaussian Splatting.

A file has a vertex for each Gaussian, with raw parameters (logit opacities, log scales). The
harmonics above band 0 are stored by channel: all coefficients of red, then green, then blue.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

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
from xrgs.splat.gaussians import Gaussians
from xrgs.splat.sh import MAX_DEGREE, bases
from xrgs.splat.torch_defaults import on_cpu_in_float32

Table = NDArray[np.float32]

_log = logging.getLogger(__name__)

_NORMALS = ("nx", "ny", "nz")
_ANTIALIASED_LINE = b"comment SplatRenderMode: mip\n"
"""Header line for antialiased Gaussians, as of Brush and SuperSplat's converter."""
#: Comments for antialiased Gaussians, in lower case: `SplatRenderMode: mip`, or Postshot's
#: `antialiased 1`.
_RENDER_MODE = re.compile(r"splatrendermode:\s*(\S+)|antialiased\s+([01])")
#: Limit of the degree of harmonics; trainers write lower degrees.
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
            has the comment `SplatRenderMode: mip`, which tells viewers to draw them so.
        durable: Whether to wait until content and name are synced to the disk.
        exact: Whether to keep the length of quaternions, so that all bits are preserved. Some
            programs draw Gaussians wrongly if the quaternions are not of unit length.

    Raises:
        OSError: The file can't be written.

    Examples:
        >>> save_ply("splats.ply", gaussians)
    """
    path = Path(path) if isinstance(path, str) else path
    quats = gaussians.quats if exact else torch.from_numpy(unit_quaternions(gaussians.quats))
    columns = [
        gaussians.means,
        torch.zeros_like(gaussians.means),  # normals, which viewers expect but ignore
        gaussians.sh0[:, 0],
        gaussians.shN.transpose(1, 2).flatten(1),
        gaussians.opacities[:, None],
        gaussians.scales,
        quats,
    ]
    table = torch.cat([column.detach().float() for column in columns], dim=1)
    header = [
        f"element vertex {len(gaussians)}",
        *(f"property float {name}" for name in _properties(gaussians.shN.shape[1])),
        "end_header",
    ]
    with atomic_writer(path, durable=durable) as file:
        file.write(b"ply\nformat binary_little_endian 1.0\n")
        file.write(_ANTIALIASED_LINE if antialiased else b"")
        file.write("".join(f"{line}\n" for line in header).encode())
        file.write(table.numpy().astype("<f4", copy=False).data)


@on_cpu_in_float32
def load_ply(path: str | Path) -> Gaussians:
    """Read the Gaussians of a .ply by `save_ply` or any 3D Gaussian Splatting trainer.

    The file may be text or binary. Properties may have any order and type, and further properties
    are ignored. Bands of the harmonics above 3 are left out, with a warning. Infinite logits of
    opacities, and logarithms of scales of -inf, become finite values that render the same. The
    filter of Mip-Splatting (`filter_3D`) is applied to scales and opacities.

    Args:
        path: The .ply file.

    Returns:
        float32 leaf tensors that require gradients. A warning says if the Gaussians are antialiased
        according to the file; `load_gaussians` returns this.

    Raises:
        XrgsError: The file is missing, damaged or not a .ply of Gaussians; the message names it.

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
    """Read Gaussians as `load_ply` does, and whether to render them antialiased."""
    check_is_read(path)
    file = ply.read(path)
    names = _columns(path, file.names)
    table = file.columns(names, np.float32)
    opacities, scales = table[:, -8], table[:, -7:-4]
    opacities[np.isposinf(opacities)] = CERTAIN_LOGIT
    opacities[np.isneginf(opacities)] = -CERTAIN_LOGIT
    scales[np.isneginf(scales)] = FLAT_LOG_SCALE
    modes = [mode for text in file.comments if (mode := _RENDER_MODE.fullmatch(text.lower()))]
    antialiased = bool(modes) and (modes[-1][1] == "mip" or modes[-1][2] == "1")
    if "filter_3D" in file.names:
        _log.warning("%s: the 3D filter of Mip-Splatting (filter_3D) is applied", path)
        sizes = file.columns(["filter_3D"], np.float64)
        check_finite(path, sizes, ["filter_3D"])
        scales[:], opacities[:] = _filtered(scales, opacities, sizes)
        antialiased = True  # as Mip-Splatting renders
    check_finite(path, table, names)
    values = {
        "means": table[:, :3],
        "sh0": table[:, None, 3:6],
        # The file stores shN by channel, memory by coefficient.
        "shN": table[:, 6:-8].reshape(len(table), 3, (len(names) - 14) // 3).swapaxes(1, 2),
        "opacities": opacities,
        "scales": scales,
        "quats": table[:, -4:],
    }
    return SavedGaussians(to_gaussians(values), antialiased)


def _properties(rest: int) -> list[str]:
    """Return the names of a vertex's properties, with `rest` SH coefficients above band 0."""
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
    """Return the names of the file's properties for all parameters, in the order of `_properties`.

    If some are missing, XrgsError says what kind of file it seems to be.
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
            "which are not supported"
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
    """Convolve Gaussians with isotropic ones of standard deviation `sizes` [N, 1].

    The formula is in `xrgs.training.components.mip`.
    """
    with np.errstate(over="ignore", invalid="ignore"):  # NaN is refused later
        variances = np.exp(2 * scales.astype(np.float64))
        filtered = variances + sizes**2
        alpha = 1 / (1 + np.exp(-opacities.astype(np.float64)))
        alpha *= np.sqrt(variances / filtered).prod(axis=1)
    bounds = np.finfo(np.float32)
    alpha = alpha.clip(bounds.tiny, 1 - bounds.eps)
    return np.log(filtered) / 2, np.log(alpha / (1 - alpha))
