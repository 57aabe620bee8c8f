"""Reads and writes files of Gaussians, in the format of the file's suffix."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

from xrgs.errors import XrgsError
from xrgs.formats.glb import read_glb, write_glb
from xrgs.formats.ply import read_ply, save_ply
from xrgs.formats.saved import SavedGaussians, check_is_read
from xrgs.formats.spz import read_spz, write_spz
from xrgs.splat.gaussians import Gaussians
from xrgs.splat.torch_defaults import on_cpu_in_float32

#: Suffix of a file -> function that reads it. `save_gaussians` writes all these formats.
READERS: dict[str, Callable[[Path], SavedGaussians]] = {
    ".ply": read_ply,
    ".glb": read_glb,
    ".spz": read_spz,
}
#: The up direction of most .ply files.
_UP = (0.0, -1.0, 0.0)


@on_cpu_in_float32
def load_gaussians(path: str | Path) -> SavedGaussians:
    """Read a file of Gaussians, and whether to render them antialiased.

    Args:
        path: A .ply of any 3DGS trainer, a .glb with KHR_gaussian_splatting, or a .spz of version 2
            to 4 (version 4 needs zstandard: pip install 'xrgs[spz]').

    Returns:
        `gaussians`, float32 leaf tensors that require gradients, and `antialiased`.

    Raises:
        XrgsError: The file is missing, damaged or of another format; the message names it.

    Examples:
        >>> gaussians, antialiased = load_gaussians("splats.ply")
        >>> render = rasterize(gaussians, camera, settings=RasterSettings(antialiased=antialiased))
    """
    path = Path(path)
    return READERS[_suffix(path)](path)


@on_cpu_in_float32
def save_gaussians(
    path: str | Path,
    gaussians: Gaussians,
    *,
    antialiased: bool = False,
    up: Sequence[float] = _UP,
) -> None:
    """Write Gaussians to a .ply, .glb or .spz file, which is replaced atomically.

    .ply and .glb store float32. .spz is about ten times smaller, and stores most values in 8 bits.

    Args:
        path: The file to write.
        gaussians: The Gaussians.
        antialiased: Whether they were trained with `RasterSettings.antialiased`, for viewers.
        up: The direction [3] that viewers of a .glb show upwards; the other formats don't store it.

    Raises:
        XrgsError: The suffix is unknown, or the format can't store the Gaussians.
        OSError: The file can't be written.

    Examples:
        >>> save_gaussians("splats.glb", gaussians)
        >>> len(load_gaussians("splats.glb").gaussians)
        50
    """
    path = Path(path)
    writers: dict[str, Callable[..., None]]
    writers = {".ply": save_ply, ".glb": partial(write_glb, up=up), ".spz": write_spz}
    writers[_suffix(path)](path, gaussians, antialiased=antialiased)


def _suffix(path: Path) -> str:
    check_is_read(path)
    suffix = path.suffix.lower()
    if suffix not in READERS:
        raise XrgsError(f"{path}: its name must end with one of {', '.join(READERS)}")
    return suffix
