"""Reads the transforms.json of nerfstudio, instant-ngp and Blender's scenes of NeRF."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from xrgs.capture.lens import MODELS, Lens, lens_of_model
from xrgs.capture.poses.given import GivenPoses
from xrgs.errors import StoreError, UnreadableError, XrgsError
from xrgs.runtime.text import listed
from xrgs.safeio.files import is_inside
from xrgs.safeio.records import as_number, read_struct

#: The largest file that is read, in bytes: a thousand views take one MB.
_MAX_BYTES = 1 << 26
#: From camera axes of OpenGL (x right, y up, z backwards) to OpenCV's, and back.
_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
#: How far the columns of a rotation may be from orthogonal and equally long, for rounded digits.
_MAX_SKEW = 0.01
#: The keys that give a focal length; a frame that has one has none of the whole file.
_FOCAL = ("fl_x", "fl_y", "camera_angle_x", "camera_angle_y", "x_fov", "y_fov")
#: Names of models that OpenCV's terms describe, whichever of them the file has.
_OPENCV = ("PERSPECTIVE", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV")
_TERM = re.compile(r"(k|p|s|sx|sy)\d+|k|omega|alpha|beta")
#: Keys of a camera that is not served, where they are neither 0, false nor empty.
_NOT_SERVED = re.compile(
    r"ftheta_\w+|latlong|equirectangular|rolling_shutter|from_mitsuba|distortion_params"
)
#: Keys that are read, and keys that change neither a camera nor the points beside it: the scale and
#: the place of the whole scene, which poses and points share, and how sharp a picture is.
_KNOWN = {
    *("frames", "file_path", "transform_matrix", "ply_file_path", "camera_model", "is_fisheye"),
    *("w", "h", "cx", "cy", *_FOCAL, "applied_transform", "applied_scale", "aabb_scale"),
    *("scale", "offset", "sharpness", "colmap_im_id"),
}


def files(file: Path) -> list[Path]:
    """Return the files that are read: the transforms.json and the points that it names.

    Raises:
        UnreadableError: The file can't be read now.
        XrgsError: The file is malformed, or names no points.
    """
    return [file, _points_file(file, _content(file))]


def read(file: Path) -> GivenPoses:
    """Read a transforms.json and its points.

    Raises:
        UnreadableError: A file can't be read now.
        XrgsError: A file is malformed; the message names it.
    """
    from xrgs.capture import colmap

    content = _content(file)
    points_file = _points_file(file, content)
    points, colors = colmap.read_points(points_file)
    frames = {frame["file_path"]: frame for frame in content["frames"]}

    def camera(name: str, stored: tuple[int, int]) -> tuple[Lens, NDArray[np.float64]]:
        frame = frames[name]
        try:
            return _lens(content, frame, stored), _viewmat(frame.get("transform_matrix"))
        except (ValueError, TypeError, OverflowError, XrgsError) as error:
            raise XrgsError(f"{file}: the camera of {name}: {error}") from error

    notes = _notes(file, content)
    if (colors == colmap.GREY).all():
        notes.append(f"{points_file.name} has no colours: the splats begin grey")
    return GivenPoses(list(frames), camera, points, colors, notes=notes)


def _content(file: Path) -> dict[str, Any]:
    """Read the file, and check that its frames have names."""
    try:
        content = read_struct(file, dict[str, Any], _MAX_BYTES)
    except UnreadableError:
        raise
    except StoreError as error:
        raise XrgsError(f"{error}; a folder of COLMAP's or a transforms.json is needed") from error
    frames = content.get("frames")
    if not isinstance(frames, list) or not all(
        isinstance(frame, dict)
        and isinstance(frame.get("file_path"), str)
        and PurePosixPath(frame["file_path"]).name
        for frame in frames
    ):
        raise XrgsError(f"{file}: not a transforms.json: each of its frames must have a file_path")
    names = [frame["file_path"] for frame in frames]
    if twice := [name for i, name in enumerate(names) if name in names[:i]]:
        raise XrgsError(f"{file}: two frames have the file_path {twice[0]}")
    return content


def _points_file(file: Path, content: Mapping[str, Any]) -> Path:
    """Return the .ply of points that a transforms.json names, which lies in or below its folder."""
    name = content.get("ply_file_path")
    if name is None:
        raise XrgsError(
            f"{file}: it has no ply_file_path: training begins with points, so name a .ply of"
            " coloured points there, as ns-process-data does (sparse_pc.ply)"
        )
    inside = str(PurePosixPath(name)) if isinstance(name, str) else ""
    if not is_inside(inside):
        raise XrgsError(f"{file}: ply_file_path must be a path below the folder of this file")
    return file.parent / inside


def _notes(file: Path, content: Mapping[str, Any]) -> list[str]:
    """Name the keys that are not read."""
    notes, frames = [], content["frames"]
    keys = dict.fromkeys([*content, *(key for frame in frames for key in frame)])
    terms = {key for key in keys if _TERM.fullmatch(key) or _NOT_SERVED.fullmatch(key)}
    if masked := [frame["file_path"] for frame in frames if frame.get("mask_path")]:
        notes.append(
            f"mask_path of {len(masked)} images in {file.name} is not read; "
            "scene.masks=FOLDER takes masks"
        )
    if unread := [key for key in keys if key not in {*_KNOWN, *terms, "mask_path"}]:
        notes.append(f"keys of {file.name} that are not read: {listed(unread)}")
    return notes


def _lens(content: Mapping[str, Any], frame: Mapping[str, Any], stored: tuple[int, int]) -> Lens:
    """Return the camera of a frame, with the values of the whole file where it has none.

    Args:
        content: The whole file.
        frame: The frame.
        stored: Width and height that the photograph is stored with, px, where the file has none.
    """
    own_focal = any(key in frame for key in _FOCAL)
    entry = {k: v for k, v in content.items() if not (own_focal and k in _FOCAL)} | dict(frame)
    if others := [key for key in entry if _NOT_SERVED.fullmatch(key) and np.any(entry[key])]:
        raise XrgsError(f"{others[0]} is not served: undistort the images, or use another camera")
    size = tuple(int(as_number(entry.get(key, s))) for key, s in zip("wh", stored, strict=True))
    fx, fy = (_focal(entry, axis, side) for axis, side in zip("xy", size, strict=True))
    focal = fy if fx is None else fx
    if focal is None:
        raise XrgsError("it has no focal length; set fl_x, in px, or camera_angle_x, in radians")
    values = {key: as_number(entry[key]) for key in entry if _TERM.fullmatch(key)}
    model = _model(entry, values)
    values |= {"f": focal, "fx": focal, "fy": focal if fy is None else fy}
    values |= {
        key: as_number(entry.get(key, side / 2))
        for key, side in zip(("cx", "cy"), size, strict=True)
    }
    names = MODELS.get(model, ())
    if "k" in names:  # the name of the only radial term
        values.setdefault("k", values.pop("k1", 0.0))
    unserved = [key for key in values if _TERM.fullmatch(key) and values[key] and key not in names]
    if unserved and model in MODELS:
        raise XrgsError(
            f"camera model {model} has no term {', '.join(f'{k}={values[k]:g}' for k in unserved)}"
        )
    return lens_of_model(model, (size[0], size[1]), [values.get(name, 0.0) for name in names])


def _model(entry: Mapping[str, Any], terms: Mapping[str, float]) -> str:
    """Return the name of COLMAP's camera model."""
    if entry.get("is_fisheye"):  # of instant-ngp
        return "OPENCV_FISHEYE"
    name = str(entry.get("camera_model", "OPENCV")).upper()
    if name not in _OPENCV:
        return name
    # nerfstudio's k3 is OpenCV's, of the sixth power of the radius. Its k4 is not.
    return "FULL_OPENCV" if terms.get("k3") and not terms.get("k4") else "OPENCV"


def _focal(entry: Mapping[str, Any], axis: str, side: int) -> float | None:
    """Return the focal length along an axis, px; None where nothing gives it."""
    if entry.get(f"fl_{axis}") is not None:
        return as_number(entry[f"fl_{axis}"])
    angle = entry.get(f"camera_angle_{axis}")
    if angle is None and entry.get(f"{axis}_fov") is not None:  # of instant-ngp, in degrees
        angle = math.radians(as_number(entry[f"{axis}_fov"]))
    return None if angle is None else side / 2 / math.tan(as_number(angle) / 2)


def _viewmat(rows: object) -> NDArray[np.float64]:
    """Invert a camera-to-world matrix of OpenGL's axes, [4, 4] or [3, 4], into a rigid viewmat."""
    matrix = np.array(rows, dtype=np.float64)
    if matrix.shape not in {(4, 4), (3, 4)} or not np.isfinite(matrix).all():
        raise ValueError("transform_matrix must be 4 x 4 finite numbers")
    # Rounded digits make a rotation that is not quite one: the nearest rotation is taken. A scale
    # of the camera's own axes changes no projection.
    U, stretch, Vt = np.linalg.svd(matrix[:3, :3])
    if stretch[0] - stretch[2] > _MAX_SKEW * stretch[0] or np.linalg.det(U @ Vt) < 0:
        raise ValueError("transform_matrix must be a rotation with a translation, not mirrored")
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = U @ Vt, matrix[:3, 3]
    return np.linalg.inv(pose @ _OPENGL).astype(np.float64)
