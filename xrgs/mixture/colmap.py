"""Writes COLMAP models with pycolmap; reads and writes points as .ply."""

from __future__ import annotations

import zlib  # noqa: F401  pycolmap 4.2.1 corrupts the heap if it is imported before zlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from xrgs.errors import XrgsError
from xrgs.runtime.signals import handlers_kept
from xrgs.safeio import ply

with handlers_kept():
    import pycolmap

#: Channel value of points without colours.
GREY = 128


@dataclass(frozen=True)
class PinholeImage:
    """An image of a COLMAP model, with its own pinhole camera."""

    name: str
    """Path of the image, relative to the folder of images."""
    width: int
    height: int
    K: NDArray[np.float64]
    """Intrinsics [3, 3], px."""
    viewmat: NDArray[np.float64]
    """World to camera [4, 4], OpenCV axes."""


def read_points(file: Path) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """Read points [P, 3] and their colours [P, 3] from a .ply file; missing colours are grey.

    Colours are `red`, `green` and `blue`, or `diffuse_red` and so on. The range is 0 to 255 for
    8-bit integers, 0 to 65535 for 16-bit integers, and for floats 0 to 1, or 0 to 255 if a value is
    above 1.

    Raises:
        XrgsError: The file is not a .ply, or its vertices have no x, y and z.
    """
    vertices = ply.read(file)
    names = [name for name in "xyz" if name not in vertices.names]
    if names:
        raise XrgsError(f"{file}: its vertices have no property {names[0]}")
    points = vertices.columns("xyz", np.float64)
    for prefix in ("", "diffuse_"):
        channels = [f"{prefix}{name}" for name in ("red", "green", "blue")]
        if set(channels) <= set(vertices.names):
            return points, _as_8_bit(vertices, channels)
    return points, np.full(points.shape, GREY, np.uint8)


def _as_8_bit(vertices: ply.Ply, channels: Sequence[str]) -> NDArray[np.uint8]:
    colors = vertices.columns(channels, np.float64)
    kind = vertices.vertices.dtype[channels[0]]
    if kind.kind == "f":
        scale = 255.0 if not (colors > 1).any() else 1.0
    else:
        scale = 255.0 / np.iinfo(kind).max if kind.itemsize == 2 else 1.0
    whole: NDArray[np.uint8] = np.round(np.nan_to_num(colors) * scale).clip(0, 255).astype(np.uint8)
    return whole


def write_model(
    folder: Path,
    images: Iterable[PinholeImage],
    points: NDArray[np.float64],
    colors: NDArray[np.uint8],
) -> None:
    """Write a binary COLMAP model of images, points [P, 3] and colours, without observations."""
    model = _with_points(points, colors)
    for number, image in enumerate(images, 1):
        K = image.K
        camera = pycolmap.Camera(
            camera_id=number,
            model="PINHOLE",
            width=image.width,
            height=image.height,
            params=[K[0, 0], K[1, 1], K[0, 2], K[1, 2]],
        )
        model.add_camera_with_trivial_rig(camera)
        posed = pycolmap.Image(name=image.name, camera_id=number, image_id=number)
        model.add_image_with_trivial_frame(posed, pycolmap.Rigid3d(image.viewmat[:3]))
    model.write_binary(folder)


def write_points(file: Path, points: NDArray[np.float64], colors: NDArray[np.uint8]) -> None:
    """Write points [P, 3] and their colours [P, 3] to a .ply file."""
    _with_points(points, colors).export_PLY(file)


def _with_points(points: NDArray[np.float64], colors: NDArray[np.uint8]) -> pycolmap.Reconstruction:
    model = pycolmap.Reconstruction()
    for point, color in zip(points, colors, strict=True):
        model.add_point3D(point, pycolmap.Track(), color)
    return model
