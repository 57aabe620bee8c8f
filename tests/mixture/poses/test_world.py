"""Given poses far from the origin of their world, and turned: the world of training is the same."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from numpy.typing import NDArray
from plyfile import PlyData, PlyElement

from tests.mixture.poses.written import POINTS, write_colmap, write_transforms
from xrgs.errors import XrgsError
from xrgs.mixture import poses
from xrgs.mixture.photographs import PhotoCollection
from xrgs.mixture.sfm import Reconstruction
from xrgs.splat.normalize import normalize_scene

SHIFTS = [(0, 0, 0), (500_000, 4_600_000, 120), (1e7, -1e7, 1e7)]
#: Rotations and shifts that a world may have.
TURN = pycolmap.Rotation3d(np.array([0.3, -1.1, 0.7])).matrix()


def written(folder: Path, layout: str, move: NDArray[np.float64], kind: str = "f8") -> Path:
    """Write poses and points of a world that was moved by a rigid transform [4, 4]."""
    moved = POINTS @ move[:3, :3].T + move[:3, 3]
    if layout == "binary":
        plain = pycolmap.Reconstruction(write_colmap(folder / "plain"))
        plain.transform(pycolmap.Sim3d(1, pycolmap.Rotation3d(move[:3, :3]), move[:3, 3]))
        folder = folder / "moved"
        folder.mkdir()
        plain.write_binary(folder)
        return folder
    file = write_transforms(folder)
    content = json.loads(file.read_text())
    for frame in content["frames"]:
        frame["transform_matrix"] = (move @ np.array(frame["transform_matrix"])).tolist()
    file.write_text(json.dumps(content))
    dtype = [(n, kind) for n in "xyz"] + [(n, "u1") for n in ("red", "green", "blue")]
    vertices = np.array([(*point, 10, 20, 30) for point in moved], dtype=dtype)
    PlyData([PlyElement.describe(vertices, "vertex")]).write(folder / "points.ply")
    return file


def rigid(turn: NDArray[np.float64], shift: tuple[float, ...]) -> NDArray[np.float64]:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = turn, shift
    return matrix


def in_order(model: Reconstruction) -> NDArray[np.float64]:
    return np.stack([model.viewmats[i] for i in sorted(model.viewmats)])


@pytest.mark.parametrize(
    ("layout", "turn"), [("binary", TURN), ("transforms", np.eye(3)), ("transforms", TURN)]
)
def test_shift_and_turn_change_nothing_in_the_world_of_training(
    photos: PhotoCollection, tmp_path: Path, layout: str, turn: NDArray[np.float64]
) -> None:
    """All that a score depends on is the same up to the rounding of the given numbers."""
    first = None
    for number, shift in enumerate(SHIFTS):
        move = rigid(turn, shift)
        model = poses.read_poses(str(written(tmp_path / str(number), layout, move)), photos)
        assert np.abs(model.points).max() < 10
        assert np.abs(in_order(model)).max() < 10
        found = normalize_scene(in_order(model), model.points)
        # The way back, in float64: a share of 2e-16 of the distance to the origin.
        back = np.linalg.inv(model.world)
        given = POINTS @ move[:3, :3].T + move[:3, 3]
        returned = model.points @ back[:3, :3].T + back[:3, 3]
        assert np.abs(returned - given).max() <= 1e-15 * np.abs(shift).sum() + 1e-12
        if first is None:
            unmoved = poses.read_poses(str(written(tmp_path / "u", layout, np.eye(4))), photos)
            first = normalize_scene(in_order(unmoved), unmoved.points)
        # 64 bits round 1e7 to 2e-9, and the cameras are a tenth apart: 2e-8 of the baseline.
        assert np.abs(found.points - first.points).max() < 1e-7 * np.abs(first.points).max()
        assert np.abs(found.viewmats - first.viewmats).max() < 1e-7 * np.abs(first.viewmats).max()
        assert found.scene_scale == pytest.approx(first.scene_scale, rel=1e-7)


def test_points_that_32_bits_have_rounded_are_not_used(
    photos: PhotoCollection, tmp_path: Path
) -> None:
    """A float of UTM's coordinates is a multiple of half a metre."""
    far = poses.read_poses(
        str(written(tmp_path / "far", "transforms", rigid(TURN, SHIFTS[1]), "f4")), photos
    )
    assert len(far.points) == len(far.colors) == 0  # they are triangulated then
    (note,) = far.report["notes"]
    assert note.startswith("the points of variant.poses are not used: 32 bits round them to steps")
    near = written(tmp_path / "near", "transforms", rigid(TURN, (0, 0, 2)), "f4")
    assert len(poses.read_poses(str(near), photos).points) == len(POINTS)


@pytest.mark.parametrize(
    ("shift", "with_points"), [((0, 0, 0), True), ((5e5, 4e6, 100), True), ((5e5, 4e6, 100), False)]
)
def test_cameras_that_are_all_at_one_place_are_refused(
    photos: PhotoCollection, tmp_path: Path, shift: tuple[float, ...], with_points: bool
) -> None:
    file = written(tmp_path / "a", "transforms", np.eye(4))
    content = json.loads(file.read_text())
    for frame in content["frames"]:
        for row, value in zip(frame["transform_matrix"], shift, strict=False):
            row[3] = value
    if not with_points:
        del content["ply_file_path"]
    file.write_text(json.dumps(content))
    with pytest.raises(XrgsError, match=r"variant\.poses=.*all 3 cameras are at one place"):
        poses.read_poses(str(file), photos)
