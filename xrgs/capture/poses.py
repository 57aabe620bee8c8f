"""Takes cameras and points from a file of the user's in place of a new SfM: `variant.poses`.

Two layouts are read: a folder of COLMAP (`cameras`, `images` and `points3D`, binary or text), and
the `transforms.json` of nerfstudio, in which `ply_file_path` names the points. A pose belongs to
the photograph of the same name, whatever the suffix and the folders before it.

Nothing here imports pycolmap before cameras are read.
"""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Mapping, Sequence
from dataclasses import replace
from difflib import get_close_matches
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any

import numpy as np

from xrgs.capture.lens import UNDISTORT, Lens, lens_of_terms
from xrgs.errors import StoreError, UnreadableError, XrgsError
from xrgs.safeio.files import is_inside, is_transient, list_names
from xrgs.safeio.hashing import file_digest
from xrgs.safeio.paths import user_path
from xrgs.safeio.records import as_number, read_struct
from xrgs.safeio.sanitize import for_line

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from xrgs.capture.photographs import PhotoCollection
    from xrgs.capture.sfm import Reconstruction

_log = logging.getLogger(__name__)

_REQUIRED, _OPTIONAL = ("cameras", "images", "points3D"), ("frames", "rigs")
#: The largest transforms.json that is read, in bytes: a thousand views take one MB.
_MAX_JSON_BYTES = 1 << 26
#: The fewest points: a Gaussian's first size is the distance of a point to its three nearest.
_MIN_POINTS = 4
#: The largest difference of the aspect ratios of an image and its photograph, which rounding of
#: their sides to whole px explains.
_MAX_ASPECT = 0.01
#: nerfstudio's names of the terms of OpenCV's camera model.
_TERMS = {"fl_x": "fx", "fl_y": "fy"} | {
    name: name for name in ("cx", "cy", "k1", "k2", "k3", "k4", "p1", "p2")
}
#: From camera axes of OpenGL (x right, y up, z backwards) to OpenCV's, and back.
_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


def fingerprint(path: str) -> str:
    """Hash the files that poses are read from: 64 hexadecimal digits of a SHA-256.

    It does not depend on where the files are.

    Raises:
        UnreadableError: A file can't be read now.
        XrgsError: Files are missing, or their layout is not one of the two.
    """
    sha256 = hashlib.sha256()
    try:
        for file in _files(path):
            sha256.update(f"{file.name}\0{file_digest(file)}\n".encode())
    except OSError as error:
        kind = UnreadableError if is_transient(error) else XrgsError
        raise kind(f"variant.poses={path}: {error.filename}: {error.strerror}") from error
    return sha256.hexdigest()


def _files(path: str) -> list[Path]:
    """Return the files that are read."""
    root = user_path(path)
    if not root.exists():
        raise XrgsError(f"variant.poses={path}: no such folder or file")
    if not root.is_dir():
        return [root, _points_file(root, _transforms(root))]
    names = list_names(root)
    for suffix in (".bin", ".txt"):  # pycolmap prefers the binary files, too
        if all(f"{name}{suffix}" in names for name in _REQUIRED):
            found = [f"{name}{suffix}" for name in (*_REQUIRED, *_OPTIONAL)]
            return [root / name for name in found if name in names]
    raise XrgsError(
        f"variant.poses={path}: it must have cameras, images and points3D, all .bin or all .txt; "
        "COLMAP's folder is often called sparse/0"
    )


def read_poses(path: str, photos: PhotoCollection) -> Reconstruction:
    """Read the cameras of the HR views of photographs, and all points, from `variant.poses`.

    Raises:
        UnreadableError: A file can't be read now.
        XrgsError: The files are malformed, a camera model is not supported, no photograph has the
            name of an image, or there are too few points.
    """
    root, content = user_path(path), fingerprint(path)
    try:
        model = _read_transforms(root, photos) if root.is_file() else _read_colmap(root, photos)
        lenses = {i: _of_hr_view(lens, photos, i) for i, lens in model.lenses.items()}
        points = model.points[np.isfinite(model.points).all(axis=1)]
        if len(points) < max(_MIN_POINTS, len(model.points)):
            raise XrgsError(
                f"{len(points)} of {len(model.points)} points are usable; at least {_MIN_POINTS} "
                "points, all of them finite, are needed to begin training with"
            )
    except UnreadableError:
        raise
    except XrgsError as error:
        raise XrgsError(f"variant.poses={path}: {error}") from error
    report = {"poses": content, "images": len(photos)} | model.report
    return replace(model, lenses=lenses, report=report)


def _of_hr_view(lens: Lens, photos: PhotoCollection, index: int) -> Lens:
    photo = photos[index]
    width, height = photo.size
    if abs(lens.width * height / (lens.height * width) - 1) > _MAX_ASPECT:
        raise XrgsError(
            f"the camera of {photo.name} is for images of {lens.width}x{lens.height} px, and the "
            f"photograph has {width}x{height}: these are not the same picture"
        )
    return photo.to_hr(lens)


def match_names(poses: Sequence[str], names: Sequence[str]) -> dict[str, int]:
    """Find the photograph of each pose: the one of the same path, or else of the same file name.

    Args:
        poses: The names of images in a file of poses, with folders and suffix.
        names: The names of the photographs.

    Returns:
        The index of the photograph by the name of the pose. A warning names the poses without one.

    Raises:
        XrgsError: No pose has a photograph, or two have the same.
    """
    index = {name: i for i, name in enumerate(names)}
    found: dict[str, int] = {}
    for pose in poses:
        parts = PurePosixPath(pose).with_suffix("").parts
        for name in ("_".join(parts), parts[-1] if parts else ""):
            if name in index:
                found[pose] = index[name]
                break
    if not found:
        similar = get_close_matches(PurePosixPath(poses[0]).stem, names, 1, 0.0) if poses else []
        example = f": {poses[0]} is not {similar[0]}" if similar else ""
        why = f"none of its {len(poses)} images has the name of a photograph{example}"
        raise XrgsError(f"{why}; rename them")
    if len(set(found.values())) < len(found):
        values = list(found.values())
        twice = next(i for i in values if values.count(i) > 1)
        raise XrgsError(f"two of its images have the name of the photograph {names[twice]}")
    if unused := [pose for pose in poses if pose not in found]:
        listed = ", ".join(unused[:6]) + (", ..." if len(unused) > 6 else "")
        _log.warning("%s", for_line(f"poses of no photograph: {len(unused)} ({listed})"))
    return found


def _read_colmap(folder: Path, photos: PhotoCollection) -> Reconstruction:
    from xrgs.capture import colmap

    return colmap.read_model(folder, lambda poses: match_names(poses, photos.names))


def _read_transforms(file: Path, photos: PhotoCollection) -> Reconstruction:
    from xrgs.capture import colmap
    from xrgs.capture.sfm import Reconstruction

    content = _transforms(file)
    points, colors = colmap.read_points(_points_file(file, content))
    frames = {frame["file_path"]: frame for frame in content["frames"]}
    found = match_names(list(frames), photos.names)
    lenses, viewmats = {}, {}
    for name, i in found.items():
        try:
            lenses[i] = _lens({**content, **frames[name]}, photos[i].size)
            viewmats[i] = _viewmat(frames[name].get("transform_matrix"))
        except (ValueError, TypeError, OverflowError) as error:
            raise XrgsError(f"the camera of {name} is malformed ({error})") from error
    observed: dict[int, NDArray[np.intp]] = {i: np.zeros(0, np.intp) for i in viewmats}
    report = {"registered": len(viewmats), "points": len(points)}
    return Reconstruction(lenses, viewmats, points, colors, observed, report)


def _transforms(file: Path) -> dict[str, Any]:
    """Read a transforms.json, and check that its frames have names."""
    try:
        content = read_struct(file, dict[str, Any], _MAX_JSON_BYTES)
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
    if len({frame["file_path"] for frame in frames}) < len(frames):
        raise XrgsError(f"{file}: two frames have one file_path")
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


def _lens(entry: Mapping[str, Any], size: tuple[int, int]) -> Lens:
    """Return the camera of a frame; `entry` has its values, and the file's where it has none."""
    model = str(entry.get("camera_model", "OPENCV"))
    if "FISHEYE" in model.upper() or "EQUIRECT" in model.upper():
        raise XrgsError(f"camera model {model} is not supported. {UNDISTORT}")
    width, height = (int(entry.get(key, side)) for key, side in zip("wh", size, strict=True))
    terms = {ours: as_number(entry[name]) for name, ours in _TERMS.items() if name in entry}
    if "fx" not in terms:
        raise XrgsError("it has no focal length; set fl_x, in px")
    defaults = {"fy": terms["fx"], "cx": width / 2, "cy": height / 2}
    return lens_of_terms(model, (width, height), defaults | terms)


def _viewmat(rows: object) -> NDArray[np.float64]:
    """Invert a camera-to-world matrix [4, 4] of OpenGL's axes into a rigid viewmat."""
    matrix = np.array(rows, dtype=np.float64)
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
        raise ValueError("transform_matrix must be 4 x 4 finite numbers")
    # Rounded digits make a rotation that is not quite one: the nearest rotation is taken.
    U, stretch, Vt = np.linalg.svd(matrix[:3, :3])
    if np.abs(stretch - 1).max() > 1e-3 or np.linalg.det(U @ Vt) < 0:
        raise ValueError("transform_matrix must be a rotation with a translation, without scale")
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = U @ Vt, matrix[:3, 3]
    return np.linalg.inv(pose @ _OPENGL).astype(np.float64)
