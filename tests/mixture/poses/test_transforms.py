"""The transforms.json of nerfstudio, instant-ngp and Blender, and what can't be served of it."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from plyfile import PlyData, PlyElement

from tests.mixture.poses.written import NAMES, PARAMS, POINTS, SIZE, viewmat, write_transforms
from xrgs.errors import XrgsError
from xrgs.mixture import colmap
from xrgs.mixture.poses import transforms
from xrgs.photos.lens import Lens

FIRST = f"./images/{NAMES[0]}"
STORED = (102, 76)


def read(folder: Path, changes: dict[str, Any], frame: dict[str, Any] | None = None) -> Lens:
    """The camera of the first frame."""
    given = transforms.read([write_transforms(folder / "poses", changes, frame)])
    lens, matrix = given.camera(FIRST, STORED)
    assert np.allclose(matrix, viewmat(0), atol=1e-9)
    return lens


def test_what_nerfstudio_writes_is_read_without_a_word(tmp_path: Path) -> None:
    frame = {"colmap_im_id": 1}
    file = write_transforms(tmp_path / "a", {"applied_transform": np.eye(4)[:3].tolist()}, frame)
    given = transforms.read([file])
    assert given.notes == []
    assert np.allclose(given.points, POINTS, atol=1e-6)
    assert transforms.files([file]) == [file, tmp_path / "a" / "points.ply"]
    for i, name in enumerate(NAMES):
        lens, matrix = given.camera(f"./images/{name}", STORED)
        assert (lens.model, lens.params, (lens.width, lens.height)) == ("PINHOLE", PARAMS, SIZE)
        assert np.allclose(matrix, viewmat(i), atol=1e-9)


NO_FOCAL = {"fl_x": None, "fl_y": None, "cx": None, "cy": None}


@pytest.mark.parametrize(
    ("changes", "frame", "expected"),
    [
        ({"fl_y": 140.0}, None, (150, 140, 104, 75)),
        ({"fl_x": None, "fl_y": 140.0}, None, (140, 140, 104, 75)),
        # Blender: the angle of view over the width, square pixels, the centre, no size.
        (
            {**NO_FOCAL, "w": None, "h": None, "camera_angle_x": 2 * math.atan(51 / 80)},
            None,
            (80, 80, 51, 38),
        ),
        (
            {
                **NO_FOCAL,
                "camera_angle_x": 2 * math.atan(102 / 80),
                "camera_angle_y": 2 * math.atan(76 / 90),
            },
            None,
            (80, 90, 102, 76),
        ),
        ({**NO_FOCAL, "camera_angle_y": 2 * math.atan(76 / 90)}, None, (90, 90, 102, 76)),
        ({**NO_FOCAL, "x_fov": 2 * math.degrees(math.atan(102 / 80))}, None, (80, 80, 102, 76)),
        # A frame's own values are taken in place of those of the file, whichever key has them.
        ({}, {"camera_angle_x": 2 * math.atan(102 / 80)}, (80, 80, 104, 75)),
        ({}, {"w": 102, "h": 76, "cx": 50, "cy": 38}, (150, 150, 50, 38)),
    ],
)
def test_the_intrinsics_of_each_program_are_read(
    tmp_path: Path,
    changes: dict[str, Any],
    frame: dict[str, Any] | None,
    expected: tuple[float, ...],
) -> None:
    lens = read(tmp_path, changes, frame)
    assert lens.model == "PINHOLE"
    assert lens.params == pytest.approx(expected)


def opencv(rays: NDArray[np.float64], terms: dict[str, float]) -> NDArray[np.float64]:
    """OpenCV's documented formula of its camera model, with the centre at PARAMS."""
    k1, k2, k3, k4, k5, k6, p1, p2 = (
        terms.get(key, 0.0) for key in ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")
    )
    x, y = rays.T
    r2 = x**2 + y**2
    radial = (1 + k1 * r2 + k2 * r2**2 + k3 * r2**3) / (1 + k4 * r2 + k5 * r2**2 + k6 * r2**3)
    u = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x**2)
    v = y * radial + p1 * (r2 + 2 * y**2) + 2 * p2 * x * y
    fx, fy, cx, cy = PARAMS
    return np.stack([fx * u + cx, fy * v + cy], -1)


def fisheye(rays: NDArray[np.float64], terms: dict[str, float]) -> NDArray[np.float64]:
    """OpenCV's documented formula of its fisheye model, with the centre at PARAMS."""
    r = np.linalg.norm(rays, axis=-1, keepdims=True)
    theta = np.arctan(r)
    bent = theta * (1 + sum(terms.get(f"k{n}", 0.0) * theta ** (2 * n) for n in range(1, 5)))
    projected: NDArray[np.float64] = bent / r * rays * PARAMS[:2] + PARAMS[2:]
    return projected


@pytest.mark.parametrize(
    ("model", "terms", "formula"),
    [
        ("OPENCV", {"k1": 0.1, "k2": -0.02, "k3": 0.01, "p1": 0.003}, opencv),
        (None, {"k1": 0.1, "p2": 0.01, "k4": 0.0}, opencv),
        ("PINHOLE", {"k1": 0.1}, opencv),
        ("FULL_OPENCV", {f"k{n}": 0.01 * n for n in range(1, 7)} | {"p1": 0.01}, opencv),
        ("OPENCV_FISHEYE", {f"k{n}": 0.01 * n for n in range(1, 5)}, fisheye),
        ("SIMPLE_RADIAL_FISHEYE", {"k1": 0.02}, fisheye),
        ("is_fisheye", {"k1": 0.02, "k2": -0.01, "k3": 0.0, "k4": 0.0}, fisheye),
    ],
)
def test_distortion_is_opencvs(
    tmp_path: Path,
    model: str | None,
    terms: dict[str, float],
    formula: Callable[..., NDArray[np.float64]],
) -> None:
    """In the file, and in a frame."""
    named = {"is_fisheye": True} if model == "is_fisheye" else {"camera_model": model}
    camera = {**terms, **{key: value for key, value in named.items() if value}}
    rays = np.random.default_rng(0).uniform(-0.5, 0.5, (20, 2))
    for lens in (read(tmp_path / "a", camera), read(tmp_path / "b", {}, camera)):
        assert lens.project(rays) == pytest.approx(formula(rays, terms), abs=1e-9)


@pytest.mark.parametrize(("rows", "digits", "scale"), [(3, 4, 0.5), (4, 3, 1), (4, 12, 1)])
def test_the_nearest_rotation_is_taken(
    tmp_path: Path, rows: int, digits: int, scale: float
) -> None:
    file = write_transforms(tmp_path / "a")
    content = transforms._content(file)
    matrix = np.array(content["frames"][1]["transform_matrix"])
    matrix[:3, :3] *= scale
    found = transforms._viewmat(np.round(matrix, digits)[:rows].tolist())
    assert np.abs(found - viewmat(1)).max() < 3 * 10**-digits / scale
    assert found[:3, :3] @ found[:3, :3].T == pytest.approx(np.eye(3), abs=1e-12)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"frames": [{"file_path": 3}]}, "each of its frames must have a file_path"),
        (
            {"frames": 2 * [{"file_path": "a.png"}]},
            r"two frames have the file_path a\.png",
        ),
        ({"ply_file_path": "../points.ply"}, "must be a path below"),
        ({"ply_file_path": "gone.ply"}, "gone.ply: .*No such file"),
        (NO_FOCAL, "it has no focal length; set fl_x, in px, or camera_angle_x, in radians"),
        ({"fl_x": "wide"}, "could not convert string"),
        ({"w": 0}, "focal length must be above 0"),
        ({"camera_model": "EQUIRECTANGULAR"}, "EQUIRECTANGULAR: a panorama has no pinhole camera"),
        ({"camera_model": "FISHEYE624"}, "FISHEYE624: must be one of SIMPLE_PINHOLE"),
        ({"camera_model": "OPENCV", "k4": 0.2}, r"camera model OPENCV has no term k4=0\.2"),
        ({"k6": 0.2}, r"camera model OPENCV has no term k6=0\.2"),
        ({"is_fisheye": True, "p1": 0.1}, r"camera model OPENCV_FISHEYE has no term p1=0\.1"),
        ({"rolling_shutter": [0, 0, 1, 0]}, "rolling_shutter is not served"),
        ({"ftheta_p1": 0.1}, "ftheta_p1 is not served"),
    ],
)
def test_what_is_not_served_is_named(tmp_path: Path, changes: dict[str, Any], message: str) -> None:
    with pytest.raises(XrgsError, match=message):
        read(tmp_path, changes)


@pytest.mark.parametrize(
    "matrix",
    [None, np.eye(3), np.diag([1.0, 1, -1, 1]), np.diag([1.0, 1.1, 1, 1]), np.zeros((4, 4))],
)
def test_a_matrix_that_is_no_pose_is_named(
    tmp_path: Path, matrix: NDArray[np.float64] | None
) -> None:
    rows = None if matrix is None else matrix.tolist()
    file = write_transforms(tmp_path / "a", {}, {"transform_matrix": rows})
    with pytest.raises(XrgsError, match=f"camera of {FIRST}: transform_matrix must be"):
        transforms.read([file]).camera(FIRST, STORED)


def test_keys_that_are_not_read_are_named(tmp_path: Path) -> None:
    changes = {"aabb_scale": 16, "k4": 0.0, "rolling_shutter": [0, 0, 0, 0], "enable_depth": True}
    frame = {"sharpness": 1.0, "depth_file_path": "depth/a.png"}
    changes |= {"w": None, "ply_file_path": None}
    given = transforms.read([write_transforms(tmp_path / "a", changes, frame)])
    assert given.notes == [
        "keys of transforms.json that are not read: enable_depth, depth_file_path",
        "transforms.json has no w and h: its focal lengths are of the photographs' own size",
    ]
    assert given.points.shape == (0, 3)


def test_a_file_of_windows_is_read(tmp_path: Path) -> None:
    """With a byte order mark, and backslashes in paths."""
    file = write_transforms(tmp_path / "a", {"ply_file_path": ".\\points.ply"})
    file.write_bytes(b"\xef\xbb\xbf" + file.read_bytes())
    given = transforms.read([file])
    assert np.allclose(given.points, POINTS, atol=1e-6)
    assert transforms.files([file]) == [file, tmp_path / "a" / "points.ply"]


def test_the_parts_of_blender_are_read_as_one(tmp_path: Path) -> None:
    """Each part has an angle of its own; the first points that any of them names are taken."""
    parts = []
    for i, split in enumerate(("test", "train")):
        names = [f"{split}/{name}" for name in NAMES]
        changes = NO_FOCAL | {"camera_angle_x": 1.0 + i, "ply_file_path": None}
        file = write_transforms(tmp_path / split, changes, names=names)
        parts.append(file.rename(tmp_path / f"transforms_{split}.json"))
    (tmp_path / "transforms_notes.txt").touch()
    assert transforms.in_folder(tmp_path) == parts == transforms.files(parts)
    given = transforms.read(parts)
    assert len(given.names) == 6
    for i, split in enumerate(("test", "train")):
        lens, matrix = given.camera(f"./images/{split}/{NAMES[2]}", STORED)
        assert lens.params[0] == pytest.approx(102 / math.tan((1 + i) / 2))
        assert np.allclose(matrix, viewmat(2), atol=1e-9)
    (tmp_path / "transforms.json").write_bytes(parts[0].read_bytes())
    assert transforms.in_folder(tmp_path) == [tmp_path / "transforms.json"]


def test_masks_are_named_by_image(tmp_path: Path) -> None:
    file = write_transforms(tmp_path / "a", {}, {"mask_path": "./masks/a.png"})
    mask = tmp_path / "a" / "masks" / "a.png"
    assert transforms.masks([file]) == {f"./images/{name}": mask for name in NAMES}
    assert mask in transforms.files([file])
    windows = write_transforms(tmp_path / "w", {}, {"mask_path": ".\\masks\\a.png"})
    assert {*transforms.masks([windows]).values()} == {tmp_path / "w" / "masks" / "a.png"}
    file = write_transforms(tmp_path / "b", {}, {"mask_path": "../a.png"})
    with pytest.raises(XrgsError, match="mask_path must be a path below the folder"):
        transforms.masks([file])


# points


RGB = ("red", "green", "blue")
COLORS = np.random.default_rng(2).integers(0, 256, (len(POINTS), 3))


@pytest.mark.parametrize(
    ("kind", "names", "scale"),
    [
        ("u1", RGB, 1.0),
        ("u1", tuple(f"diffuse_{name}" for name in RGB), 1.0),
        ("u2", RGB, 257.0),
        ("f4", RGB, 1 / 255),
        ("f4", RGB, 1.0),
        ("f8", RGB[::-1], 1.0),
    ],
)
def test_colours_of_any_type_are_read(
    tmp_path: Path, kind: str, names: tuple[str, ...], scale: float
) -> None:
    values = COLORS[:, ::-1] if names[0] == "blue" else COLORS
    dtype = [(axis, "f8") for axis in "xyz"] + [(name, kind) for name in names]
    rows = np.array([(*p, *c) for p, c in zip(POINTS, values * scale, strict=True)], dtype=dtype)
    cameras = np.array([(1.0,), (2.0,)], dtype=[("view_px", "f4")])
    elements = [PlyElement.describe(cameras, "camera"), PlyElement.describe(rows, "vertex")]
    PlyData(elements, byte_order=">").write(tmp_path / "a.ply")
    points, colors = colmap.read_points(tmp_path / "a.ply")
    assert points == pytest.approx(POINTS)
    assert (colors == COLORS).all()
