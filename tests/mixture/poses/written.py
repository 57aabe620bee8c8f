"""Writes poses as COLMAP and nerfstudio do, of cameras and points whose projections are known."""

from __future__ import annotations

import json
import zlib  # noqa: F401  pycolmap corrupts the heap where it is imported before zlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray
from plyfile import PlyData, PlyElement

#: The camera of the whole photographs, which the files are half as large as.
SIZE, PARAMS = (204, 152), (150.0, 150.0, 104.0, 75.0)
POINTS = np.random.default_rng(1).uniform((-1, -1, 3), (1, 1, 5), (12, 3))
NAMES = ("day1/a.jpg", "day1/b.jpg", "c.jpg")


def viewmat(index: int) -> NDArray[np.float64]:
    turn = pycolmap.Rotation3d(np.array([0.1 * index, -0.2, 0.05])).matrix()
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = turn, (0.1 * index, 0.2, 0.3)
    return matrix


def to_world(index: int) -> NDArray[np.float64]:
    """The columns are right, up and backwards of the camera, and its centre."""
    rotation, translation = viewmat(index)[:3, :3], viewmat(index)[:3, 3]
    pose = np.eye(4)
    pose[:3, :3] = rotation.T * (1, -1, -1)
    pose[:3, 3] = -rotation.T @ translation
    return pose


def project(index: int) -> NDArray[np.float64]:
    """Pixels [P, 2] of the points in the whole photographs."""
    camera = POINTS @ viewmat(index)[:3, :3].T + viewmat(index)[:3, 3]
    fx, fy, cx, cy = PARAMS
    return camera[:, :2] / camera[:, 2:] * (fx, fy) + (cx, cy)


def write_model(
    folder: Path,
    camera: pycolmap.Camera,
    matrices: Mapping[str, NDArray[np.float64]],
    points: NDArray[np.float64] = POINTS,
    *,
    text: bool = False,
) -> Path:
    """Write a model of COLMAP of one camera: its viewmat [4, 4] in each image, and points."""
    rec = pycolmap.Reconstruction()
    camera.camera_id = 1
    rec.add_camera_with_trivial_rig(camera)
    for i, (name, matrix) in enumerate(matrices.items()):
        image = pycolmap.Image(name=name, camera_id=1, image_id=i + 1)
        rec.add_image_with_trivial_frame(image, pycolmap.Rigid3d(matrix[:3]))
    for point in points:
        rec.add_point3D(point, pycolmap.Track(), np.array([10, 20, 30], np.uint8))
    folder.mkdir(parents=True)
    (rec.write_text if text else rec.write_binary)(folder)
    return folder


def write_colmap(
    folder: Path,
    model: str = "PINHOLE",
    params: Sequence[float] = PARAMS,
    *,
    names: Sequence[str] = NAMES,
    size: tuple[int, int] = SIZE,
    text: bool = False,
) -> Path:
    camera = pycolmap.Camera(model=model, width=size[0], height=size[1], params=params)
    matrices = {name: viewmat(i) for i, name in enumerate(names)}
    return write_model(folder, camera, matrices, text=text)


def write_transforms(
    folder: Path,
    changes: Mapping[str, Any] | None = None,
    frame: Mapping[str, Any] | None = None,
    names: Sequence[str] = NAMES,
) -> Path:
    """Write a transforms.json with changes; None removes a key. `frame` is in each frame."""
    folder.mkdir(parents=True)
    dtype = [(n, "f4") for n in "xyz"] + [(n, "u1") for n in ("red", "green", "blue")]
    vertices = np.array([(*point, 10, 20, 30) for point in POINTS], dtype=dtype)
    PlyData([PlyElement.describe(vertices, "vertex")]).write(folder / "points.ply")
    frames = [
        {"file_path": f"./images/{name}", "transform_matrix": to_world(i).tolist(), **(frame or {})}
        for i, name in enumerate(names)
    ]
    fx, fy, cx, cy = PARAMS
    content = {"w": SIZE[0], "h": SIZE[1], "fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy}
    content |= {"ply_file_path": "points.ply", "frames": frames} | dict(changes or {})
    content = {key: value for key, value in content.items() if value is not None}
    (folder / "transforms.json").write_text(json.dumps(content))
    return folder / "transforms.json"
