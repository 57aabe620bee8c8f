"""Writes COLMAP's models with pycolmap; reads and writes points as .ply."""

from __future__ import annotations

import zlib  # noqa: F401  pycolmap 4.2.1 corrupts the heap where it is imported before zlib
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

from xrgs.capture import sfm
from xrgs.errors import XrgsError

#: The colour of points without one.
GREY = 128


@dataclass(frozen=True)
class PinholeImage:
    """An image with a pinhole camera of its own, for a model."""

    name: str
    """Its path below the folder of images."""
    width: int
    height: int
    K: NDArray[np.float64]
    """Intrinsics [3, 3], px."""
    viewmat: NDArray[np.float64]
    """World to camera [4, 4], OpenCV axes."""


def read_points(file: Path) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """Read points [P, 3] and their colours [P, 3] from a .ply file, ASCII or binary.

    Raises:
        XrgsError: The file is not such a .ply.
    """
    model = pycolmap.Reconstruction()
    try:
        model.import_PLY(file)
    # MemoryError: COLMAP makes room for as many points as the header declares.
    except (RuntimeError, ValueError, IndexError, MemoryError) as error:
        raise XrgsError(f"not a .ply of points with colours ({error})") from error
    return sfm.points_of(model)


def write_model(
    folder: Path,
    images: Iterable[PinholeImage],
    points: NDArray[np.float64],
    colors: NDArray[np.uint8],
) -> None:
    """Write a binary model of COLMAP without observations.

    Args:
        folder: An existing folder.
        images: The images; each gets a PINHOLE camera of its own.
        points: Points [P, 3].
        colors: Their colours [P, 3].
    """
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
