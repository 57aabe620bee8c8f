"""Gaussians as .ply files in the layout of INRIA, which viewers of 3D Gaussian Splatting open.

A file is binary little endian float32 with one vertex for each Gaussian and its raw parameters
(logit opacities, log scales). The harmonics above band 0 are stored by channel: all coefficients of
red, then green, then blue.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import BinaryIO

import numpy as np
import torch
from numpy.typing import NDArray

from xrgs.errors import XrgsError
from xrgs.safeio.atomic import atomic_writer
from xrgs.splat.gaussians import Gaussians
from xrgs.splat.sh import MAX_DEGREE, bases

MAX_HEADER_LINES = 512
MAX_LINE_BYTES = 1024
_NORMALS = ("nx", "ny", "nz")
_MAGIC = b"ply\n"
_FORMAT = "format binary_little_endian 1.0"


def save_ply(path: str | Path, gaussians: Gaussians, *, durable: bool = True) -> None:
    """Write Gaussians to a .ply file, which is replaced atomically.

    Args:
        path: The file to write.
        gaussians: The N Gaussians; they are written as float32, in raw parameters (logarithms of
            scales, logits of opacities).
        durable: Whether to wait until the content and the name are on the disk.

    Raises:
        OSError: The file can't be written.
    """
    path = Path(path) if isinstance(path, str) else path
    count = len(gaussians)
    columns = [
        gaussians.means,
        torch.zeros_like(gaussians.means),  # normals, which viewers expect and do not use
        gaussians.sh0[:, 0],
        gaussians.shN.transpose(1, 2).flatten(1),
        gaussians.opacities[:, None],
        gaussians.scales,
        gaussians.quats,
    ]
    table = torch.cat([column.detach().float() for column in columns], dim=1)
    names = _properties(gaussians.shN.shape[1])
    header = [_FORMAT, f"element vertex {count}", *(f"property float {n}" for n in names)]
    with atomic_writer(path, durable=durable) as file:
        file.write(_MAGIC + "".join(f"{line}\n" for line in [*header, "end_header"]).encode())
        file.write(table.numpy().astype("<f4").tobytes())


def load_ply(path: str | Path) -> Gaussians:
    """Read Gaussians that `save_ply`, or any 3D Gaussian Splatting trainer, wrote.

    Args:
        path: The .ply file; its properties may come in any order, all of them float32.

    Returns:
        float32 leaf tensors with gradients on.

    Raises:
        XrgsError: the file is missing, truncated or not such a .ply; the message names it.
    """
    path = Path(path) if isinstance(path, str) else path
    try:
        with path.open("rb") as file:
            count, names = _read_header(file, path)
            body_bytes = os.fstat(file.fileno()).st_size - file.tell()
            if body_bytes != count * len(names) * 4:  # before reading: the file may be huge
                raise XrgsError(
                    f"{path}: {count} vertices of {len(names)} floats need "
                    f"{count * len(names) * 4} bytes, {body_bytes} follow the header"
                )
            body = file.read(body_bytes)
    except OSError as error:
        raise XrgsError(f"{path}: cannot be read: {error.strerror}") from error
    if len(body) != body_bytes:
        raise XrgsError(f"{path}: grew shorter while it was read")
    table = np.frombuffer(body, dtype="<f4").reshape(count, len(names))
    if not np.isfinite(table).all():
        raise XrgsError(f"{path}: has values that are not finite")
    return _gaussians(table, names, path)


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


def _read_header(file: BinaryIO, path: Path) -> tuple[int, list[str]]:
    """Return the number of vertices and their columns; leave `file` at the first vertex."""
    if file.readline(len(_MAGIC)) != _MAGIC:
        raise XrgsError(f"{path}: is not a .ply file")
    count = -1
    names: list[str] = []
    for _ in range(MAX_HEADER_LINES):
        line = file.readline(MAX_LINE_BYTES)
        words = line.decode("ascii", errors="replace").split()
        match words:
            case ["end_header"] if count >= 0:
                if len(set(names)) != len(names):
                    raise XrgsError(f"{path}: the header names a property twice")
                return count, names
            case ["comment" | "obj_info", *_]:
                pass
            case ["format", *_] if " ".join(words) == _FORMAT:
                pass
            case ["element", "vertex", digits] if count < 0 and _is_count(digits):
                count = int(digits)
            case ["property", "float" | "float32", name] if count >= 0:
                names.append(name)
            case _:
                shown = line[:80].decode("ascii", errors="replace").rstrip()
                raise XrgsError(f"{path}: unexpected line in the .ply header: {shown!r}")
    raise XrgsError(f"{path}: the .ply header has no end")


def _is_count(digits: str) -> bool:
    """Return whether a string is a number of vertices that memory could hold."""
    return digits.isascii() and digits.isdigit() and len(digits) <= 12


def _gaussians(table: NDArray[np.float32], names: list[str], path: Path) -> Gaussians:
    """Return the parameters in a table [N, columns] of named columns."""
    stored = sum(name.startswith("f_rest_") for name in names)
    if stored not in {3 * (bases(degree) - 1) for degree in range(MAX_DEGREE + 1)}:
        raise XrgsError(f"{path}: {stored} f_rest properties are not a whole number of SH bands")
    required = [name for name in _properties(stored // 3) if name not in _NORMALS]
    missing = [name for name in required if name not in names]
    if missing:
        raise XrgsError(f"{path}: properties are missing: {', '.join(missing)}")
    # In a fixed order whatever the file's, so that the parameters can be split off one by one.
    ordered = torch.from_numpy(table[:, [names.index(name) for name in required]])
    widths = {"means": 3, "sh0": 3, "shN": stored, "opacities": 1, "scales": 3, "quats": 4}
    values = dict(zip(widths, ordered.split(list(widths.values()), dim=1), strict=True))
    values["opacities"] = values["opacities"][:, 0]  # [N]
    values["sh0"] = values["sh0"][:, None]  # [N, 1, 3]
    values["shN"] = values["shN"].reshape(len(table), 3, stored // 3).transpose(1, 2)
    contiguous = torch.contiguous_format
    leaves = {name: value.clone(memory_format=contiguous) for name, value in values.items()}
    return Gaussians(**{name: value.requires_grad_() for name, value in leaves.items()})
