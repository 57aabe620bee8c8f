"""Given cameras that are refused, and poses and points that are moved to a world of their own."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest
from numpy.typing import NDArray
from PIL import Image
from plyfile import PlyData, PlyElement

from tests.mixture.poses.written import POINTS, SIZE, to_world, write_colmap, write_transforms
from xrgs.errors import XrgsError
from xrgs.mixture import poses
from xrgs.mixture.photographs import PhotoCollection
from xrgs.mixture.views import Reconstruction
from xrgs.splat.normalize import normalize_scene

SHIFTS = [(0, 0, 0), (500_000, 4_600_000, 120), (1e7, -1e7, 1e7)]
#: Rotations and shifts that a world may have.
TURN = pycolmap.Rotation3d(np.array([0.3, -1.1, 0.7])).matrix()


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        ({"fl_x": 4.0, "fl_y": 4.0}, "focal length of 4 and 4 px"),
        ({"fl_x": None, "fl_y": None, "camera_angle_x": 3.13}, "focal length of"),
        ({"fl_x": None, "fl_y": None, "camera_angle_x": 90}, "camera_angle_x=90 must be"),
        ({"fl_x": None, "fl_y": None, "x_fov": 180}, "camera_angle_x=3.14"),
        ({"fl_x": -150.0}, "focal length must be above 0"),
        ({"fl_x": float("nan")}, "not valid JSON"),
        ({"fl_y": 900.0}, "focal lengths of 150 and 900 px, too unequal"),
        ({"cx": 900.0}, "principal point at 900, 75 px"),
    ],
)
def test_a_camera_that_can_not_be_is_refused_by_name(
    photos: PhotoCollection, tmp_path: Path, changes: dict[str, Any], why: str
) -> None:
    file = write_transforms(tmp_path / "poses", changes)
    with pytest.raises(XrgsError, match=rf"variant\.poses=.*{why}"):
        poses.read_poses(str(file), photos)


@pytest.mark.parametrize("row", [None, [0, 0, 1, 1], [0, 0, 0, 1.001]])
def test_a_last_row_of_a_projection_is_refused(
    photos: PhotoCollection, tmp_path: Path, row: list[float] | None
) -> None:
    matrix = to_world(0)
    if row is None:
        matrix = matrix.T  # written by columns
    else:
        matrix[3] = row
    file = write_transforms(tmp_path / "a", frame={"transform_matrix": matrix.tolist()})
    with pytest.raises(XrgsError, match=r"camera of .*a\.jpg: transform_matrix must be of rows"):
        poses.read_poses(str(file), photos)


@pytest.mark.parametrize(
    ("size", "named"),
    [
        ((102, 76), False),
        ((51, 38), False),
        ((205, 153), False),  # twice as large, rounded down
        ((101, 75), True),
        ((153, 114), True),
    ],
)
def test_cameras_of_pictures_of_another_size_are_named(
    photos: PhotoCollection, tmp_path: Path, size: tuple[int, int], named: bool
) -> None:
    """The photographs have 102 x 76 px."""
    scale = size[0] / SIZE[0]
    changes = {"w": size[0], "h": size[1], "fl_x": 150 * scale, "fl_y": 150 * scale}
    changes |= {"cx": size[0] / 2, "cy": size[1] / 2}
    model = poses.read_poses(str(write_transforms(tmp_path / "poses", changes)), photos)
    notes = [note for note in model.report["notes"] if "another size" in note]
    assert bool(notes) == named
    if named:
        assert f"as {size[0]}x{size[1]} for 102x76 px" in notes[0]
        assert notes[0].endswith("a, b, c")


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"w": 102, "h": 76}, "102% of the width and 99% of the height"),  # sizes were halved
        ({"w": 408, "h": 304}, "25% of the width and 25% of the height"),
        ({"cx": 104.0 + 30}, ""),  # a lens with shift
    ],
)
def test_a_size_that_was_changed_without_its_focal_lengths_is_named(
    photos: PhotoCollection, tmp_path: Path, changes: dict[str, Any], named: str
) -> None:
    """The principal point tells: it is in pixels of the size before."""
    model = poses.read_poses(str(write_transforms(tmp_path / "poses", changes)), photos)
    notes = [note for note in model.report["notes"] if "far from the middle" in note]
    assert bool(notes) == bool(named)
    assert all(named in note and note.endswith("a, b, c") for note in notes)


@pytest.mark.parametrize("layout", ["dense/sparse", "sparse/0", "images beside"])
def test_the_model_of_undistorted_images_is_not_taken_for_the_photographs(
    photos: PhotoCollection, tmp_path: Path, layout: str
) -> None:
    """The layouts of COLMAP's image_undistorter, of 3DGS's convert.py, and of nerfstudio."""
    root, names = tmp_path / "scene", ("a.jpg", "b.jpg", "c.jpg")
    size = (98, 73)
    if layout == "images beside":
        changes = {"w": size[0], "h": size[1], "fl_x": 75, "fl_y": 75, "cx": 49, "cy": 36.5}
        path = write_transforms(root, changes, names=names)
    else:
        params = (75.0, 75.0, 49.0, 36.5)
        path = write_colmap(root / layout, params=params, names=names, size=size)
    images = root / ("dense/images" if layout == "dense/sparse" else "images")
    images.mkdir(parents=True)
    for name in names:
        Image.new("RGB", size).save(images / name)
    with pytest.raises(XrgsError, match=rf"its cameras are of .*images, .*scene\.path={images}"):
        poses.read_poses(str(path), photos)


@pytest.mark.parametrize(
    ("name", "what"),
    [
        ("poses.zip", "an archive"),
        ("cameras.xml", "as Metashape's cameras are"),
        ("project.PSX", "a project of Metashape"),
        ("registration.csv", "a table"),
        ("poses_bounds.npy", "LLFF's poses_bounds.npy"),
        ("database.db", "COLMAP's database, which has no poses"),
        ("points.ply", "which has no cameras"),
        ("images.txt", "give the folder that it is in"),
        ("photograph.xmp", "as RealityScan's cameras are"),
        ("arrays.npz", "arrays of numpy"),
        ("scene.usdz", "a scene of an animation program"),
        ("reconstruction.json", "a file of OpenSfM"),
        ("sfm_data.bin", "a file of OpenMVG"),
    ],
)
def test_files_of_other_programs_are_named_with_what_to_do(
    tmp_path: Path, name: str, what: str
) -> None:
    (tmp_path / name).write_bytes(b"content")
    with pytest.raises(XrgsError, match=rf"variant\.poses=.*it is .*{what}|{what}"):
        poses.fingerprint(str(tmp_path / name))
    if name not in ("images.txt", "points.ply", "registration.csv"):
        todo = {"poses.zip": "unpack it", "database.db": "give the folder of its model"}
        todo_here = todo.get(name, "export the cameras")
        with pytest.raises(XrgsError, match=rf"{name} can't be read: {todo_here}"):
            poses.fingerprint(str(tmp_path))


@pytest.mark.parametrize(
    ("content", "program"),
    [
        ({"sfm_data_version": "0.3", "views": []}, "it is of OpenMVG"),
        ({"version": ["1"], "featuresFolders": []}, "it is of Meshroom"),
        ([{"shots": {}, "cameras": {}}], "it is of OpenSfM"),
        ([{"id": 0, "img_name": "a"}], "it is of 3D Gaussian Splatting"),
        ({"views": []}, "each of its frames must have a file_path"),
        ([], "each of its frames must have a file_path"),
    ],
)
def test_a_json_of_another_program_is_named(tmp_path: Path, content: object, program: str) -> None:
    (tmp_path / "a.json").write_text(json.dumps(content))
    with pytest.raises(XrgsError, match=rf"a\.json: not a transforms\.json.*{program}"):
        poses.fingerprint(str(tmp_path / "a.json"))


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
