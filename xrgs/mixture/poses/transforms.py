"""Reads the transforms.json of nerfstudio, instant-ngp and Blender's scenes of NeRF."""

from __future__ import annotations

import codecs
import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from xrgs.errors import StoreError, UnreadableError, XrgsError
from xrgs.mixture.poses.given import GivenPoses
from xrgs.photos import foreign
from xrgs.photos.lens import MODELS, Lens, lens_of_model
from xrgs.runtime.text import listed
from xrgs.safeio.files import is_inside, list_names
from xrgs.safeio.records import as_number, decode_struct, read_file

#: Names in a folder: a file with all images, or one for each split, as in Blender's scenes.
_WHOLE, _NAME = "transforms.json", re.compile(r"transforms(_\w+)?\.json")
#: Size limit of a file, bytes: a thousand views take about 1 MB.
_MAX_BYTES = 1 << 26
#: Converts camera axes between OpenGL (x right, y up, z backwards) and OpenCV.
_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
#: Tolerance of a rotation for rounded digits: 1 minus the ratio of its singular values.
_MAX_SKEW = 0.01
#: Tolerance of a matrix's last row, 0, 0, 0, 1.
_MAX_LAST_ROW = 1e-6
#: Keys of a focal length. If a frame has one of them, those of the file are ignored.
_FOCAL = ("fl_x", "fl_y", "camera_angle_x", "camera_angle_y", "x_fov", "y_fov")
#: Camera models that are read as OpenCV's, with any of its distortion terms.
_OPENCV = ("PERSPECTIVE", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV")
_TERM = re.compile(r"(k|p|s|sx|sy)\d+|k|omega|alpha|beta")
#: Keys of unsupported cameras, if their value is not 0, false or empty.
_NOT_SERVED = re.compile(
    r"ftheta_\w+|latlong|equirectangular|rolling_shutter|from_mitsuba|distortion_params"
)
#: Keys that are read, and keys that may be ignored silently: scale and position of the whole scene,
#: which poses and points share, and the sharpness of a picture.
_KNOWN = {
    *("file_path", "transform_matrix", "ply_file_path", "camera_model", "is_fisheye"),
    *("w", "h", "cx", "cy", *_FOCAL, "applied_transform", "applied_scale", "aabb_scale"),
    *("scale", "offset", "sharpness", "colmap_im_id", "rotation", "mask_path"),
}


def in_folder(folder: Path) -> list[Path]:
    """Return the transforms.json of a folder, else the files of splits (transforms_train.json)."""
    names = [name for name in list_names(folder) if _NAME.fullmatch(name)]
    return [folder / name for name in names if name == _WHOLE or _WHOLE not in names]


def files(parts: Sequence[Path]) -> list[Path]:
    """Return all files to read: the transforms.json files, and the points and masks they name."""
    contents = _contents(parts)
    return [*parts, *_points_files(contents)[:1], *_masks(_frames(contents)).values()]


def masks(parts: Sequence[Path]) -> dict[str, Path]:
    """Return image name -> mask, of the images with a `mask_path`."""
    return _masks(_frames(_contents(parts)))


def read(parts: Sequence[Path]) -> GivenPoses:
    """Read the transforms.json, or the files of its splits, and the points.

    XrgsError names a file that is malformed.
    """
    from xrgs.mixture import colmap

    contents = _contents(parts)
    frames = _frames(contents)

    def camera(name: str, stored: tuple[int, int]) -> tuple[Lens, NDArray[np.float64]]:
        file, entry = frames[name]
        try:
            return _lens(entry, stored), _viewmat(entry.get("transform_matrix"))
        except (ValueError, TypeError, OverflowError, XrgsError) as error:
            raise XrgsError(f"{file}: the camera of {name}: {error}") from error

    points, notes = np.zeros((0, 3)), _notes(parts, frames)
    colors = points.astype(np.uint8)
    for file in _points_files(contents)[:1]:
        points, colors = colmap.read_points(file)
        if (colors == colmap.GREY).all():
            notes.append(f"{file.name} has no colours: the splats begin grey")
    return GivenPoses(list(frames), camera, points, colors, notes=notes)


def _frames(contents: Mapping[Path, dict[str, Any]]) -> dict[str, tuple[Path, dict[str, Any]]]:
    """Return image name -> its transforms.json, and its values.

    Values that a frame lacks are those of the file.
    """
    frames: dict[str, tuple[Path, dict[str, Any]]] = {}
    for file, content in contents.items():
        for frame in content["frames"]:
            name = frame["file_path"]
            if name in frames:
                raise XrgsError(f"{file}: two frames have the file_path {name}")
            has_focal = any(key in frame for key in _FOCAL)
            shared = {k: v for k, v in content.items() if not (has_focal and k in _FOCAL)}
            entry = {k: v for k, v in (shared | frame).items() if v is not None and k != "frames"}
            frames[name] = file, entry
    return frames


def _contents(parts: Sequence[Path]) -> dict[Path, dict[str, Any]]:
    return {file: _content(file) for file in parts}


def _content(file: Path) -> dict[str, Any]:
    """Read a file, and check that its frames have names."""
    try:
        # Some editors and shells of Windows write the mark, which JSON has not.
        text = read_file(file, _MAX_BYTES).removeprefix(codecs.BOM_UTF8)
        content: Any = decode_struct(text, object, file)
    except UnreadableError:
        raise
    except StoreError as error:
        raise XrgsError(f"{error}; a folder of COLMAP's or a transforms.json is needed") from error
    frames = content.get("frames") if isinstance(content, dict) else None
    if not isinstance(frames, list) or not all(
        isinstance(frame, dict)
        and isinstance(frame.get("file_path"), str)
        and PurePosixPath(frame["file_path"]).name
        for frame in frames
    ):
        why = foreign.of_json(content) or ": each of its frames must have a file_path"
        raise XrgsError(f"{file}: not a transforms.json{why}")
    own: dict[str, Any] = content
    return own


def _points_files(contents: Mapping[Path, Mapping[str, Any]]) -> list[Path]:
    """Return the .ply files that the transforms.json files name; only the first is read."""
    named = [(file, content.get("ply_file_path")) for file, content in contents.items()]
    return [_below(file, "ply_file_path", name) for file, name in named if name is not None]


def _masks(frames: Mapping[str, tuple[Path, Mapping[str, Any]]]) -> dict[str, Path]:
    return {
        name: _below(file, "mask_path", entry["mask_path"])
        for name, (file, entry) in frames.items()
        if entry.get("mask_path")
    }


def _below(file: Path, key: str, name: object) -> Path:
    """Return the path of a file that a transforms.json names; it must be below its folder."""
    inside = str(PurePosixPath(name.replace("\\", "/"))) if isinstance(name, str) else ""
    if not is_inside(inside):
        raise XrgsError(f"{file}: {key} must be a path below the folder of this file")
    return file.parent / inside


def _notes(
    parts: Sequence[Path], frames: Mapping[str, tuple[Path, Mapping[str, Any]]]
) -> list[str]:
    """Return notes on ignored keys and on a missing image size."""
    entries = [entry for _, entry in frames.values()]
    keys = dict.fromkeys(key for entry in entries for key in entry)
    files, notes = listed([file.name for file in parts]), []
    known = (_TERM, _NOT_SERVED)
    unread = [k for k in keys if k not in _KNOWN and not any(form.fullmatch(k) for form in known)]
    if unread:
        notes.append(f"keys of {files} that are not read: {listed(unread)}")
    if any(("fl_x" in e or "fl_y" in e) and not ("w" in e and "h" in e) for e in entries):
        notes.append(f"{files} has no w and h: its focal lengths are of the photographs' own size")
    return notes


def _lens(entry: Mapping[str, Any], stored: tuple[int, int]) -> Lens:
    """Return the camera of a frame.

    `stored` is the stored width and height of the photograph, px, if the frame has no size.
    """
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
    if "k" in names:  # COLMAP's name if there is only one radial term
        values.setdefault("k", values.pop("k1", 0.0))
    unserved = [key for key in values if _TERM.fullmatch(key) and values[key] and key not in names]
    if unserved and model in MODELS:
        raise XrgsError(
            f"camera model {model} has no term {', '.join(f'{k}={values[k]:g}' for k in unserved)}"
        )
    return lens_of_model(model, (size[0], size[1]), [values.get(name, 0.0) for name in names])


def _model(entry: Mapping[str, Any], terms: Mapping[str, float]) -> str:
    """Return the name of COLMAP's camera model."""
    if entry.get("is_fisheye"):  # instant-ngp's key
        return "OPENCV_FISHEYE"
    name = str(entry.get("camera_model", "OPENCV")).upper()
    if name not in _OPENCV:
        return name
    # nerfstudio's k3, of the sixth power of the radius, is that of OpenCV; its k4 is not.
    return "FULL_OPENCV" if terms.get("k3") and not terms.get("k4") else "OPENCV"


def _focal(entry: Mapping[str, Any], axis: str, side: int) -> float | None:
    """Return the focal length along an axis, px; None if it is missing."""
    if entry.get(f"fl_{axis}") is not None:
        return as_number(entry[f"fl_{axis}"])
    angle = entry.get(f"camera_angle_{axis}")
    if angle is None and entry.get(f"{axis}_fov") is not None:  # instant-ngp's key, in degrees
        angle = math.radians(as_number(entry[f"{axis}_fov"]))
    if angle is None:
        return None
    if not 0 < as_number(angle) < math.pi:
        raise ValueError(f"camera_angle_{axis}={angle} must be between 0 and pi, in radians")
    return side / 2 / math.tan(as_number(angle) / 2)


def _viewmat(rows: object) -> NDArray[np.float64]:
    """Convert a camera-to-world matrix with OpenGL axes, [4, 4] or [3, 4], to a rigid viewmat."""
    matrix = np.array(rows, dtype=np.float64)
    if matrix.shape not in {(4, 4), (3, 4)} or not np.isfinite(matrix).all():
        raise ValueError("transform_matrix must be 4 x 4 finite numbers")
    if len(matrix) == 4 and np.abs(matrix[3] - (0, 0, 0, 1)).max() > _MAX_LAST_ROW:
        raise ValueError(
            "transform_matrix must be of rows, the last of them 0, 0, 0, 1; is it of columns?"
        )
    # Take the nearest rotation, to correct rounded digits. A scale of the camera's axes does not
    # change projections.
    U, stretch, Vt = np.linalg.svd(matrix[:3, :3])
    if not stretch[2] > (1 - _MAX_SKEW) * stretch[0] or np.linalg.det(U @ Vt) < 0:
        raise ValueError("transform_matrix must be a rotation with a translation, not mirrored")
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = U @ Vt, matrix[:3, 3]
    return np.linalg.inv(pose @ _OPENGL).astype(np.float64)
