"""Points that are found for given poses, on a wall whose place is known."""

from __future__ import annotations

import zlib  # noqa: F401  pycolmap corrupts the heap where it is imported before zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from numpy.typing import NDArray
from PIL import Image
from scipy.ndimage import map_coordinates
from skimage import data

from xrgs.config import VariantConf
from xrgs.mixture import poses, sfm_retries
from xrgs.mixture.photographs import PhotoCollection, prepare_hr_views
from xrgs.photos.scenes import Scene

SIZE = (240, 180)
DEPTH = 5.0
CAMERA = pycolmap.Camera(
    model="OPENCV",
    width=SIZE[0],
    height=SIZE[1],
    params=[200.0, 210.0, 125.0, 85.0, -0.15, 0.02, 0.004, -0.003],
)


def viewmat(index: int) -> NDArray[np.float64]:
    angle = 0.12 * (index - 1.5)
    matrix = np.eye(4)
    matrix[:3, :3] = pycolmap.Rotation3d(np.array([0.05 * index, angle, 0.1 * index])).matrix()
    matrix[:3, 3] = matrix[:3, :3] @ np.array([0.6 * (1.5 - index), 0.1 * index, 0.0])
    return matrix


def photograph(index: int) -> NDArray[np.uint8]:
    """The wall z = 5 through the lens: pycolmap says which ray each stored pixel sees."""
    x, y = np.meshgrid(np.arange(SIZE[0]) + 0.5, np.arange(SIZE[1]) + 0.5)
    rays = CAMERA.cam_from_img(np.stack([x.ravel(), y.ravel()], -1))
    rays = np.c_[rays, np.ones(len(rays))] @ viewmat(index)[:3, :3]
    centre = -viewmat(index)[:3, :3].T @ viewmat(index)[:3, 3]
    wall = centre + rays * ((DEPTH - centre[2]) / rays[:, 2:])
    texture = data.hubble_deep_field().astype(np.float64)
    rows, columns = 436 + 90 * wall[:, 1], 500 + 90 * wall[:, 0]
    bands = [map_coordinates(texture[..., c], (rows, columns), order=1) for c in range(3)]
    return np.stack(bands, -1).reshape(SIZE[1], SIZE[0], 3).astype(np.uint8)


@pytest.fixture
def photos(tmp_path: Path, configured: Callable[..., VariantConf]) -> PhotoCollection:
    """Four photographs of the wall, which EXIF turns by a quarter, and their poses."""
    model, files, exif = pycolmap.Reconstruction(), {}, Image.Exif()
    exif[0x112] = 6
    CAMERA.camera_id = 1
    model.add_camera_with_trivial_rig(CAMERA)
    for i in range(4):
        files[f"wall{i}"] = tmp_path / f"wall{i}.png"
        Image.fromarray(photograph(i)).save(files[f"wall{i}"], exif=exif)
        image = pycolmap.Image(name=f"wall{i}.png", camera_id=1, image_id=i + 1)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(viewmat(i)[:3]))
    (tmp_path / "poses").mkdir()
    model.write_binary(tmp_path / "poses")
    (tmp_path / "work").mkdir()
    return prepare_hr_views(Scene("x", "", files), configured(long_side=0), tmp_path / "work")


@pytest.mark.slow
def test_points_of_distorted_and_turned_photographs_are_on_the_wall(
    photos: PhotoCollection, tmp_path: Path, configured: Callable[..., VariantConf]
) -> None:
    model = poses.read_poses(str(tmp_path / "poses"), photos)
    assert len(model.points) == 0
    found = sfm_retries.with_points(model, photos, (), configured().sfm, tmp_path)
    assert len(found.points) > 50
    # Given poses are moved to a world of their own: bring the points back to the wall's.
    on_wall = (found.points - model.world[:3, 3]) @ model.world[:3, :3]
    off = np.abs(on_wall[:, 2] - DEPTH)
    # Features are found to 0.15 px: an error of depth of 0.15 z² / (f b), at a baseline b of 1.2.
    assert np.median(off) < 0.016
    assert np.quantile(off, 0.9) < 0.1
    assert found.report["notes"][-1] == (
        f"variant.poses has no points: {len(found.points)} were triangulated from the photographs"
    )
    assert found.report["reprojection_error_px"] < 0.5
    assert found.lenses == model.lenses
    assert all(len(found.observed[i]) > 20 for i in range(4))
