"""Poses of the user's: COLMAP's folders and transforms.json, against projections of points."""

from __future__ import annotations

import json
import logging
import zlib  # noqa: F401  pycolmap corrupts the heap where it is imported before zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest
from numpy.typing import NDArray
from PIL import Image
from plyfile import PlyData, PlyElement

from xrgs.capture import poses
from xrgs.capture.photographs import PhotoCollection, prepare_hr_views
from xrgs.capture.scenes import Scene
from xrgs.config import VariantConf
from xrgs.errors import XrgsError

#: The camera of the whole photographs, of which the files are half as large.
SIZE, PARAMS = (204, 152), (150.0, 150.0, 104.0, 75.0)
POINTS = np.random.default_rng(1).uniform((-1, -1, 3), (1, 1, 5), (12, 3))
NAMES = ("day1/a.jpg", "day1/b.jpg", "c.jpg")


def viewmat(index: int) -> NDArray[np.float64]:
    turn = pycolmap.Rotation3d(np.array([0.1 * index, -0.2, 0.05])).matrix()
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = turn, (0.1 * index, 0.2, 0.3)
    return matrix


@pytest.fixture
def photos(tmp_path: Path, configured: Callable[..., VariantConf]) -> PhotoCollection:
    """Three photographs of 102 x 76 px, whose HR views are cropped to 100 x 75."""
    files = {}
    for name in ("a", "b", "c"):
        pixels = np.random.default_rng(0).integers(0, 255, (76, 102, 3), dtype=np.uint8)
        Image.fromarray(pixels).save(tmp_path / f"{name}.png")
        files[name] = tmp_path / f"{name}.png"
    conf = configured(long_side=0)
    (tmp_path / "work").mkdir()
    return prepare_hr_views(Scene("x", "", files), conf, tmp_path / "work")


def write_colmap(
    folder: Path, model: str = "PINHOLE", params: tuple[float, ...] = PARAMS, *, text: bool = False
) -> Path:
    rec = pycolmap.Reconstruction()
    camera = pycolmap.Camera(camera_id=1, model=model, width=SIZE[0], height=SIZE[1], params=params)
    rec.add_camera_with_trivial_rig(camera)
    for i, name in enumerate(NAMES):
        image = pycolmap.Image(name=name, camera_id=1, image_id=i + 1)
        rec.add_image_with_trivial_frame(image, pycolmap.Rigid3d(viewmat(i)[:3]))
    for point in POINTS:
        rec.add_point3D(point, pycolmap.Track(), np.array([10, 20, 30], np.uint8))
    folder.mkdir(parents=True)
    (rec.write_text if text else rec.write_binary)(folder)
    return folder


def write_transforms(folder: Path, **changes: Any) -> Path:
    folder.mkdir(parents=True)
    dtype = [(n, "f4") for n in "xyz"] + [(n, "u1") for n in ("red", "green", "blue")]
    vertices = np.array([(*point, 10, 20, 30) for point in POINTS], dtype=dtype)
    PlyData([PlyElement.describe(vertices, "vertex")]).write(folder / "points.ply")
    frames = []
    for i, name in enumerate(NAMES):
        rotation, translation = viewmat(i)[:3, :3], viewmat(i)[:3, 3]
        pose = np.eye(4)
        # Columns: right, up and backwards of the camera, and its centre.
        pose[:3, :3] = rotation.T * (1, -1, -1)
        pose[:3, 3] = -rotation.T @ translation
        frames.append({"file_path": f"./images/{name}", "transform_matrix": pose.tolist()})
    fx, fy, cx, cy = PARAMS
    content = {"w": SIZE[0], "h": SIZE[1], "fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy}
    content |= {"ply_file_path": "points.ply", "frames": frames} | changes
    (folder / "transforms.json").write_text(json.dumps(content))
    return folder / "transforms.json"


def project(points: NDArray[np.float64], index: int) -> NDArray[np.float64]:
    """Pixels [P, 2] of the whole photographs."""
    camera = points @ viewmat(index)[:3, :3].T + viewmat(index)[:3, 3]
    fx, fy, cx, cy = PARAMS
    return camera[:, :2] / camera[:, 2:] * (fx, fy) + (cx, cy)


@pytest.mark.parametrize("layout", ["binary", "text", "transforms"])
def test_points_project_to_where_the_cropped_and_resized_photograph_shows_them(
    photos: PhotoCollection, tmp_path: Path, layout: str
) -> None:
    folder = tmp_path / "poses"
    if layout == "transforms":
        path = write_transforms(folder)
    else:
        path = write_colmap(folder, text=layout == "text")
    model = poses.read_poses(str(path), photos)
    assert np.allclose(model.points, POINTS, atol=1e-6)
    assert (model.colors == (10, 20, 30)).all()
    assert model.lenses.keys() == model.viewmats.keys() == {0, 1, 2}
    for i in range(3):
        camera = model.points @ model.viewmats[i][:3, :3].T + model.viewmats[i][:3, 3]
        pixels = camera @ model.lenses[i].K.T
        # Half the size, then 102 x 76 is cropped to 100 x 75 about its centre: 1 and 0 px.
        expected = project(POINTS, i) / 2 - (1, 0)
        assert np.allclose(pixels[:, :2] / pixels[:, 2:], expected, atol=1e-4)
        assert (model.lenses[i].width, model.lenses[i].height) == (100, 75)


def test_the_fingerprint_is_of_the_content(tmp_path: Path) -> None:
    a, b = write_colmap(tmp_path / "a"), write_colmap(tmp_path / "b")
    c = write_colmap(tmp_path / "c", params=(150.0, 150.0, 104.0, 75.5))
    assert poses.fingerprint(str(a)) == poses.fingerprint(str(b)) != poses.fingerprint(str(c))
    first = poses.fingerprint(str(write_transforms(tmp_path / "d")))
    (tmp_path / "d" / "points.ply").write_bytes(b"other points")
    assert poses.fingerprint(str(tmp_path / "d" / "transforms.json")) != first


def test_a_radial_term_is_kept_and_others_are_refused(
    photos: PhotoCollection, tmp_path: Path
) -> None:
    path = write_colmap(tmp_path / "a", "SIMPLE_RADIAL", (150.0, 104.0, 75.0, -0.05))
    assert {lens.k for lens in poses.read_poses(str(path), photos).lenses.values()} == {-0.05}
    path = write_colmap(tmp_path / "b", "OPENCV", (*PARAMS, 0.1, 0.0, 0.0, 0.0))
    assert {lens.k for lens in poses.read_poses(str(path), photos).lenses.values()} == {0.1}
    path = write_colmap(tmp_path / "c", "OPENCV", (*PARAMS, 0.1, 0.2, 0.0, 0.0))
    with pytest.raises(XrgsError, match=r"/c: camera OPENCV: .*\(k2=0\.2\).*undistorter"):
        poses.read_poses(str(path), photos)
    path = write_colmap(tmp_path / "d", "OPENCV_FISHEYE", (*PARAMS, 0.1, 0.0, 0.0, 0.0))
    with pytest.raises(XrgsError, match=r"camera model OPENCV_FISHEYE: must be one of"):
        poses.read_poses(str(path), photos)


def test_photographs_and_poses_without_each_other_are_left_out(
    caplog: pytest.LogCaptureFixture,
) -> None:
    with caplog.at_level(logging.WARNING):
        found = poses.match_names(["x/a.jpg", "gone.png", "d/c.JPG"], ["a", "b", "c", "d_c"])
    assert found == {"x/a.jpg": 0, "d/c.JPG": 3}, "the whole path is preferred"
    assert "poses of no photograph: 1 (gone.png)" in caplog.text
    with pytest.raises(XrgsError, match=r"none of its 1 images .*: IMG_01\.jpg is not img_1"):
        poses.match_names(["IMG_01.jpg"], ["other", "img_1"])
    with pytest.raises(XrgsError, match="two of its images have the name of the photograph a"):
        poses.match_names(["x/a.jpg", "y/a.jpg"], ["a"])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"ply_file_path": None}, "it has no ply_file_path: .*sparse_pc.ply"),
        ({"ply_file_path": "../points.ply"}, "must be a path below"),
        ({"ply_file_path": "gone.ply"}, "gone.ply: No such file"),
        ({"frames": [{"file_path": 3}]}, "each of its frames must have a file_path"),
        ({"fl_x": None}, "focal length must be above 0"),
        ({"w": 300}, "not the same picture"),
        ({"camera_model": "OPENCV_FISHEYE"}, "OPENCV_FISHEYE is not supported"),
        ({"p1": 0.01}, r"must be 0 \(p1=0\.01\)"),
    ],
)
def test_an_unusable_transforms_file_says_what_is_needed(
    photos: PhotoCollection, tmp_path: Path, changes: dict[str, Any], message: str
) -> None:
    path = write_transforms(tmp_path / "a", **changes)
    with pytest.raises(XrgsError, match=message):
        poses.read_poses(str(path), photos)


def test_an_unusable_folder_says_what_is_needed(photos: PhotoCollection, tmp_path: Path) -> None:
    with pytest.raises(XrgsError, match="no such folder or file"):
        poses.fingerprint(str(tmp_path / "gone"))
    (tmp_path / "empty").mkdir()
    with pytest.raises(XrgsError, match=r"cameras, images and points3D.*sparse/0"):
        poses.fingerprint(str(tmp_path / "empty"))
    path = write_colmap(tmp_path / "cut")
    (path / "images.bin").write_bytes((path / "images.bin").read_bytes()[:30])
    with pytest.raises(XrgsError, match="not a model of COLMAP"):
        poses.read_poses(str(path), photos)
