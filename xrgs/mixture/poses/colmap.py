"""Reads COLMAP models, binary and text, of any version.

pycolmap's reader is not used: it allocates any amount of memory that a file declares, accepts
truncated files, and ends names at a space. `rigs` and `frames` are not needed, since COLMAP writes
the pose of every image into `images`, also for rigs.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from xrgs.errors import XrgsError
from xrgs.mixture.poses.given import CameraOf, GivenPoses
from xrgs.photos.lens import MODELS, Lens, lens_of_model
from xrgs.runtime.text import listed
from xrgs.safeio.files import list_names
from xrgs.safeio.records import read_file

#: Names of a model's files; some programs add the project's name as a prefix.
_NAME = re.compile(r"(.*?)(cameras|images|points3d)\.(bin|txt|ply)", re.IGNORECASE)
#: Size limit of a file, bytes: a model of ten thousand images has a few GB.
_MAX_BYTES = 1 << 34
#: Point id of a feature without a point: -1 as an unsigned integer.
_NO_POINT = np.uint64(2**64 - 1)
_FEATURE = np.dtype([("x", "<f8"), ("y", "<f8"), ("point", "<u8")])
#: Size of a track's element, the ids of an image and of its feature, bytes.
_TRACK_BYTES = 8


#: The name of a camera's model, its width and height in px, and its parameters.
_Camera = tuple[str, tuple[int, int], Sequence[float]]


@dataclass(frozen=True)
class _Image:
    number: int
    name: str
    quaternion: Sequence[float]
    """World to camera, w first."""
    translation: Sequence[float]
    camera: int
    features: NDArray[np.void]
    """The image's features with a point, of type `_FEATURE`, px."""


@dataclass(frozen=True)
class _Points:
    numbers: NDArray[np.uint64]
    xyz: NDArray[np.float64]
    colors: NDArray[np.uint8]


def files(root: Path) -> list[Path]:
    """Return the files of the model in or below a folder; of several models, the largest one.

    The paths of cameras, images and, if it exists, points3D; empty if there is no model. OSError or
    XrgsError if a folder or a file can't be read.
    """
    models = _models(root)
    return models[0] if models else []


def read(root: Path) -> GivenPoses:
    """Read the model in or below a folder; XrgsError names a file that is malformed."""
    models = _models(root)
    cameras_file, images_file, *points_file = models[0]
    binary = cameras_file.suffix == ".bin"
    cameras = (_binary_cameras if binary else _text_cameras)(cameras_file)
    images: dict[str, _Image] = {}
    for image in (_binary_images if binary else _text_images)(images_file):
        if image.name in images:
            both = f"{images[image.name].number} and {image.number}"
            raise XrgsError(f"{images_file}: the images {both} have one name, {image.name}")
        images[image.name] = image
    points = _points(*points_file)
    order = np.argsort(points.numbers, kind="stable")
    numbers = points.numbers[order]

    def camera(name: str, stored: tuple[int, int]) -> tuple[Lens, NDArray[np.float64]]:  # noqa: ARG001
        image = images[name]
        if image.camera not in cameras:
            raise XrgsError(f"{images_file}: {name} has camera {image.camera}, which is missing")
        try:
            return lens_of_model(*cameras[image.camera]), _viewmat(image)
        except XrgsError as error:
            raise XrgsError(f"{images_file}: {name}: {error}") from error

    xyz = points.xyz[order]
    errors = [_errors(image, camera, numbers, xyz) for image in images.values()]
    return GivenPoses(
        list(images),
        camera,
        xyz,
        points.colors[order],
        {
            name: np.unique(_indices(image.features["point"], numbers)[0])
            for name, image in images.items()
        },
        *_report(np.concatenate([np.zeros((0, 2)), *errors]), _notes(root, models)),
    )


def _errors(
    image: _Image,
    camera: CameraOf,
    numbers: NDArray[np.uint64],
    xyz: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Compute the reprojection errors of an image, since errors stored in a model may be outdated.

    [N, 2] index of each observed point, and the distance of its projection from the feature, px:
    infinite behind the camera and outside the camera model. Empty if the camera can't be read.
    """
    try:
        lens, viewmat = camera(image.name, (0, 0))
    except XrgsError:
        return np.zeros((0, 2))
    places, known = _indices(image.features["point"], numbers)
    features = image.features[known]
    with np.errstate(all="ignore"):
        x, y, z = viewmat[:3, :3] @ xyz[places].T + viewmat[:3, 3:]
        off = lens.project(np.stack([x / z, y / z], -1)) - np.stack(
            [features["x"], features["y"]], -1
        )
        errors = np.where(z > 0, np.hypot(*off.T), np.inf)
    return np.stack([places, np.nan_to_num(errors, nan=np.inf, posinf=np.inf)], -1)


def _report(errors: NDArray[np.float64], notes: list[str]) -> tuple[dict[str, float], list[str]]:
    """Average errors [N, 2] for each point, then over the points, as COLMAP does."""
    seen = errors[np.isfinite(errors[:, 1])]
    if behind := len(errors) - len(seen):
        notes.append(
            f"{behind} of {len(errors)} observations are of points that their cameras can't see, "
            "which lie behind them or outside of the camera model: are the poses world to camera?"
        )
    if not len(seen):
        return {}, notes
    points, counts = np.unique(seen[:, 0], return_inverse=True, return_counts=True)[1:]
    return {
        "reprojection_error_px": float((np.bincount(points, seen[:, 1]) / counts).mean())
    }, notes


def _points(file: Path | None = None) -> _Points:
    """Read the points of a model; points of a .ply have no ids and no observations."""
    from xrgs.mixture.colmap import read_points

    if file is not None and file.suffix == ".bin":
        return _binary_points(file)
    if file is not None and file.suffix == ".txt":
        return _text_points(file)
    xyz, colors = (
        (np.zeros((0, 3)), np.zeros((0, 3), np.uint8)) if file is None else read_points(file)
    )
    return _Points(np.full(len(xyz), _NO_POINT), xyz, colors)


def _notes(root: Path, models: Sequence[Sequence[Path]]) -> list[str]:
    if len(models) < 2:
        return []
    taken, *others = (
        f"{files[0].parent.relative_to(root)} ({_count_images(files[1])} images)"
        for files in models
    )
    return [f"of the models of variant.poses, {taken} is taken, and not {listed(others)}"]


def _models(root: Path) -> list[list[Path]]:
    """Return the files of each model in a folder, else below it; the model of most images first."""
    below = (root, root / "sparse")
    folders = [f / name for f in below if f.is_dir() for name in list_names(f)]
    found = [
        files for folder in folders if folder.is_dir() and (files := _complete(folder)) is not None
    ]
    own = _complete(root)
    return [own] if own else sorted(found, key=lambda files: -_count_images(files[1]))


def _complete(folder: Path) -> list[Path] | None:
    """Return the paths of cameras, images and, if they exist, points of the model in a folder.

    If the model has no points3D, a .ply is taken for it. Of several models, those with points have
    precedence, then those with names without a prefix, then the first.
    """
    found: dict[tuple[str, str, str], Path] = {}
    for name in list_names(folder):
        if (match := _NAME.fullmatch(name)) and (folder / name).is_file():
            start, part, suffix = match.groups()
            found[start, part.lower(), suffix.lower()] = folder / name
    models = []
    for suffix in ("bin", "txt"):  # binary first, as COLMAP does
        for start in sorted({start for start, _, _ in found}):
            files = [found.get((start, part, suffix)) for part in ("cameras", "images")]
            points = found.get((start, "points3d", suffix)) or found.get((start, "points3d", "ply"))
            if all(files):
                models.append([file for file in (*files, points) if file is not None])
    return max(models, key=len, default=None)


def _count_images(file: Path) -> int:
    if file.suffix == ".bin":
        return _Binary(file).count(1)
    return sum(1 for _ in _text_images(file))


def _indices(
    points: NDArray[np.uint64], numbers: NDArray[np.uint64]
) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
    """Return the indices of point ids `points` in sorted ids `numbers`, and which ids exist.

    In a thinned model some points of features are missing.
    """
    places = np.searchsorted(numbers, points)
    there = places < len(numbers)
    there[there] = numbers[places[there]] == points[there]
    return places[there].astype(np.intp), there


def _viewmat(image: _Image) -> NDArray[np.float64]:
    from scipy.spatial.transform import Rotation

    if not np.isfinite([*image.quaternion, *image.translation]).all():
        raise XrgsError("its pose must have finite numbers")
    if not any(image.quaternion):
        raise XrgsError("its quaternion must not be 0; run COLMAP again, or remove the image")
    # Divided, so that the squares in the length neither overflow nor underflow.
    w, *xyz = np.array(image.quaternion) / np.abs(image.quaternion).max()
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_quat([*xyz, w]).as_matrix()
    matrix[:3, 3] = image.translation
    return matrix


# ---------------------------------------------------------------- binary


class _Binary:
    """Reads a binary COLMAP file, little endian, from beginning to end."""

    def __init__(self, file: Path) -> None:
        self._file, self._data, self._at = file, read_file(file, _MAX_BYTES), 0

    def values(self, layout: str) -> tuple[float, ...]:
        """Read values with a format of `struct`."""
        layout = f"<{layout}"
        return struct.unpack_from(layout, self._data, self._advance(struct.calcsize(layout)))

    def number(self, layout: str) -> int:
        """Read an integer with a format of `struct`."""
        return int(self.values(layout)[0])

    def count(self, least: int) -> int:
        """Read the number of the following entries, each of at least `least` bytes."""
        count = self.number("Q")
        if count * least > len(self._data) - self._at:
            raise self._cut(f"{count} entries")
        return count

    def text(self) -> str:
        """Read a zero-terminated text."""
        end = self._data.find(b"\0", self._at)
        if end < 0:
            raise self._cut("a name")
        content = self._data[self._at : end]
        self._at = end + 1
        return content.decode("utf-8", errors="replace")

    def features(self) -> NDArray[np.void]:
        """Read the features of an image, and return those with a point."""
        count = self.count(_FEATURE.itemsize)
        start = self._advance(count * _FEATURE.itemsize)
        features: NDArray[np.void] = np.frombuffer(self._data, _FEATURE, count, start)
        of_points: NDArray[np.void] = features[features["point"] != _NO_POINT]
        return of_points

    def skip(self, size: int) -> None:
        """Skip `size` bytes."""
        self._advance(size)

    def end(self) -> None:
        """Check that no bytes are left."""
        if left := len(self._data) - self._at:
            raise XrgsError(f"{self._file}: {left} bytes are left after its last entry")

    def _advance(self, size: int) -> int:
        start = self._at
        self._at += size
        if self._at > len(self._data):
            raise self._cut("an entry")
        return start

    def _cut(self, within: str) -> XrgsError:
        return XrgsError(
            f"{self._file}: it ends after {len(self._data)} bytes, within {within}: it was cut, or "
            "is no file of COLMAP; copy it again"
        )


def _binary_cameras(file: Path) -> dict[int, _Camera]:
    data, names = _Binary(file), list(MODELS)
    cameras: dict[int, _Camera] = {}
    for _ in range(data.count(24)):
        number, model, width, height = map(int, data.values("IiQQ"))
        if not 0 <= model < len(names):
            raise XrgsError(f"{file}: camera {number} has the model number {model}, not known here")
        params = data.values(f"{len(MODELS[names[model]])}d")
        cameras[number] = names[model], (width, height), params
    data.end()
    return cameras


def _binary_images(file: Path) -> Iterator[_Image]:
    data = _Binary(file)
    for _ in range(data.count(73)):
        number, *pose, camera = data.values("I7dI")
        name = data.text()
        yield _Image(int(number), name, pose[:4], pose[4:], int(camera), data.features())
    data.end()


def _binary_points(file: Path) -> _Points:
    data = _Binary(file)
    count = data.count(51)
    points = _Points(
        np.empty(count, np.uint64), np.empty((count, 3)), np.empty((count, 3), np.uint8)
    )
    for i in range(count):
        points.numbers[i], *xyz, r, g, b, _ = data.values("Q3d3Bd")
        points.xyz[i], points.colors[i] = xyz, (r, g, b)
        data.skip(data.count(_TRACK_BYTES) * _TRACK_BYTES)
    data.end()
    return points


# ---------------------------------------------------------------- text


def _text_cameras(file: Path) -> dict[int, _Camera]:
    cameras: dict[int, _Camera] = {}
    for number, line in _lines(file):
        if line:
            with _line(file, number, "CAMERA_ID MODEL WIDTH HEIGHT PARAMS"):
                own, model, width, height, *params = line.split()
                size = int(width), int(height)
                cameras[int(own)] = model, size, [float(value) for value in params]
    return cameras


def _text_images(file: Path) -> Iterator[_Image]:
    """Read the two lines of each image; the second line, its features, may be empty."""
    lines = _lines(file)
    for number, line in lines:
        if not line:
            continue
        with _line(file, number, "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME"):
            own, *pose, camera, name = line.split(maxsplit=9)  # a name may have spaces
            values = [float(value) for value in pose]
            if len(values) != 7:
                raise ValueError("not a pose")
            image = _Image(
                int(own), name, values[:4], values[4:], int(camera), np.zeros(0, _FEATURE)
            )
        below, features = next(lines, (number + 1, ""))
        with _line(file, below, f"X Y POINT3D_ID of each feature of {name}, or empty"):
            words = features.split()
            if len(words) % 3:
                raise ValueError("not in threes")
            threes = zip(words[::3], words[1::3], words[2::3], strict=True)
            own_features = [(float(x), float(y), int(p)) for x, y, p in threes if int(p) >= 0]
            yield replace(image, features=np.array(own_features, _FEATURE))


def _text_points(file: Path) -> _Points:
    numbers, positions, colors = [], [], []
    for number, line in _lines(file):
        if line:
            with _line(file, number, "POINT3D_ID X Y Z R G B ERROR TRACK"):
                own, x, y, z, r, g, b, _ = line.split(maxsplit=8)[:8]
                numbers.append(np.uint64(int(own)))
                positions.append((float(x), float(y), float(z)))
                colors.append([np.uint8(int(value)) for value in (r, g, b)])
    return _Points(
        np.array(numbers, np.uint64),
        np.array(positions, np.float64).reshape(-1, 3),
        np.array(colors, np.uint8).reshape(-1, 3),
    )


def _lines(file: Path) -> Iterator[tuple[int, str]]:
    """Yield line number, from 1, and line of a text file, without comments and byte order mark."""
    content = read_file(file, _MAX_BYTES).decode("utf-8-sig", errors="replace")
    for number, line in enumerate(content.split("\n"), 1):
        if not line.startswith("#"):
            yield number, line.strip()


@contextmanager
def _line(file: Path, number: int, form: str) -> Iterator[None]:
    """Add the line's number and its expected form to errors."""
    try:
        yield
    except (ValueError, OverflowError) as error:
        raise XrgsError(f"{file}: line {number} must be {form}") from error
