"""Writes, verifies and reads the folder of a frozen variant, whoever wrote it.

The folder is named by the variant's id: `variant.json` holds the fields of `Variant` and the hash
of every other file that decides a number, `images/<split>/<view>.png` the images, `points.npz` the
SfM points, `report.json` how SfM went, and `colmap.log` COLMAP's log. Nothing here imports torch.
"""

from __future__ import annotations

from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import numpy as np

from xrgs.capture import sealed
from xrgs.capture.views import Variant, View
from xrgs.errors import StoreError, UnreadableError, XrgsError
from xrgs.safeio import npz, untrusted
from xrgs.safeio.atomic import atomic_writer, write_json
from xrgs.safeio.confined import ConfinedPath, confined, is_passing
from xrgs.safeio.hashing import digest
from xrgs.safeio.records import errors_named, read_object
from xrgs.safeio.words import for_line

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from numpy.typing import NDArray

MANIFEST, POINTS, REPORT, LOG = "variant.json", "points.npz", "report.json", "colmap.log"
_FIELDS = frozenset({"id", "key", "scene", "factor", "held_out", "views", "files"})
_SPLITS = frozenset({"train", "test", "original"})
#: The most views of a variant, and their longest side, px.
_MAX_VIEWS, _MAX_SIDE = 1 << 14, 1 << 16
#: Pixels of all views together: so many, and as many as so many bytes of their files can hold.
#: Photographs take a byte for at most ten; a store of a few megabytes can't fill the memory.
_FREE_PIXELS, _PIXELS_PER_BYTE = 1 << 28, 100
#: The largest number of a camera or a point. Training computes with their squares in float32.
_MAX_NUMBER = 1e12
_MAX_SCENE_NAME = 250
#: The fewest points: a Gaussian's first size is the distance of a point to its three nearest.
_MIN_POINTS = 4


class CorruptVariant(XrgsError):  # noqa: N818
    """A frozen variant is damaged or was changed; the message names the file."""


def freeze(made: Variant, key: str, folder: ConfinedPath, variants: ConfinedPath) -> Variant:
    """Write a variant's fields into the folder of its images, and rename the folder to its id.

    All of it is on the disk before it has its name.

    Args:
        made: The variant; its id is not read.
        key: The key of what it was made from.
        folder: The folder of its images, of the same root as `variants`.
        variants: The folder that the variant will be in.

    Returns:
        The variant, as it is read from its new place.
    """
    with atomic_writer(folder / POINTS, durable=False) as stream:
        np.savez(stream, points=made.points, colors=made.colors)
    write_json(folder / REPORT, made.report, durable=False)
    images = {view.file.relative_to(folder) for view in made.views}
    content: dict[str, Any] = {
        "key": key,
        "scene": made.scene,
        "factor": made.factor,
        "held_out": made.held_out,
        "views": [_view_to_json(folder, view) for view in made.views],
        "files": sealed.hashes(folder, [POINTS, *sorted(images)]),
    }
    content["id"] = variant_id(content)
    write_json(folder / MANIFEST, content, durable=False)
    folder.sync_tree()
    home = variants / content["id"]
    folder.rename(home)
    home.sync_name()
    return load(home)


def variant_id(content: dict[str, Any]) -> str:
    """Compute the id of a variant: its key, then a hash of all else that decides a number.

    Args:
        content: The content of `variant.json`, with or without the id.
    """
    hashed = {k: v for k, v in content.items() if k not in ("id", "scene")}
    return f"{content['key']}-{digest(hashed)}"


def load(path: Path | ConfinedPath) -> Variant:
    """Load a frozen variant, after every hash is verified.

    Args:
        path: The variant's folder, which may come from anybody.

    Returns:
        The variant.

    Raises:
        UnreadableError: A file can't be read now; nothing is known of the variant.
        CorruptVariant: A file is missing, or is not the one that was frozen, or holds what no
            variant has, or the folder's name is not the variant's id.
    """
    folder = confined(path)
    with _errors_as_corrupt(folder):
        content = _manifest(folder)
        for error in sealed.changed(folder, content["files"]):
            raise error
        return _assembled(folder, content)


def verify(path: Path | ConfinedPath) -> list[str]:
    """Say everything that is wrong with the files of a frozen variant.

    Args:
        path: The variant's folder, which may come from anybody.

    Returns:
        A line for each file that is missing, has changed, can't be read now or does not belong
        there; empty for an intact variant.
    """
    folder = confined(path)
    errors: list[XrgsError] = []
    try:
        with _errors_as_corrupt(folder):
            content = _manifest(folder)
            errors += sealed.changed(folder, content["files"])
            errors += sealed.unlisted(folder, {MANIFEST, REPORT, LOG, *content["files"]})
            if not errors:
                _assembled(folder, content)
    except XrgsError as error:
        errors.append(error)
    return [for_line(str(error)) for error in errors]


@contextmanager
def _errors_as_corrupt(folder: ConfinedPath) -> Iterator[None]:
    """Raise `UnreadableError` for what may pass, and `CorruptVariant` for any other error."""
    try:
        yield
    except UnreadableError as error:
        raise UnreadableError(f"{error}; try again") from error
    except OSError as error:
        why = f"{error.filename or folder}: {error.strerror or error}"  # a stream's has no name
        if is_passing(error):
            raise UnreadableError(f"{why}; try again") from error
        raise CorruptVariant(why) from error
    except StoreError as error:
        raise CorruptVariant(str(error)) from error


def _manifest(folder: ConfinedPath) -> dict[str, Any]:
    """Read and check `variant.json`.

    Raises:
        StoreError: It is missing or malformed, or the folder's name is not its id.
        OSError: The folder can't be read.
    """
    file = folder / MANIFEST
    content = read_object(file)
    try:
        wrong = _wrong_field(content)
    except (ValueError, KeyError, TypeError, AttributeError, ArithmeticError) as error:
        raise StoreError(f"{file}: not a complete variant ({error!r:.200})") from error
    if wrong:
        raise StoreError(f"{file}: not a complete variant; wrong: {wrong}")
    if content["id"] != variant_id(content):
        raise StoreError(f"{file}: it has changed since it was written")
    if sealed.own_name(folder) != content["id"]:
        raise StoreError(
            f"{folder}: it holds another variant, {content['id']}, whose name it lacks"
        )
    _check_pixels(folder, content)
    return content


def _wrong_field(content: dict[str, Any]) -> str:
    """Return what is wrong in the content of `variant.json`; empty where nothing is."""
    if content.keys() != _FIELDS:
        return f"keys {', '.join(sorted(content.keys() ^ _FIELDS)):.200}"
    scene, views, files = content["scene"], content["views"], content["files"]
    rules = {
        "id": untrusted.is_name(content["id"]) and untrusted.is_name(content["key"]),
        "scene": isinstance(scene, str) and scene.isprintable() and len(scene) <= _MAX_SCENE_NAME,
        "factor": type(content["factor"]) is int and 1 <= content["factor"] <= _MAX_SIDE,
        "held_out": isinstance(content["held_out"], bool),
        "views": isinstance(views, list) and 0 < len(views) <= _MAX_VIEWS,
        "files": isinstance(files, dict) and all(isinstance(h, str) for h in files.values()),
    }
    if wrong := [name for name, valid in rules.items() if not valid]:
        return wrong[0]
    for number, entry in enumerate(views):
        if wrong_in_view := _wrong_in_view(entry):
            return f"{wrong_in_view} of view {number}"
    names = {(entry["split"], entry["name"]) for entry in views}
    if len(names) < len(views):
        return "views, of which two have one name"
    if files.keys() != {POINTS, *(entry["file"] for entry in views)}:
        return "files"
    missing = {"train", "test"} - {split for split, _ in names}
    return f"views, of which none is to {min(missing)}" if missing else ""


def _wrong_in_view(entry: object) -> str:
    """Return which value of a view in `variant.json` is wrong; empty where none is."""
    if not isinstance(entry, dict) or entry.keys() != View.__dataclass_fields__.keys():
        return "keys"
    rho = entry["rho"]
    rules = {
        "name": untrusted.is_name(entry["name"]),
        "split": entry["split"] in _SPLITS,
        "file": entry["file"] == f"images/{entry['split']}/{entry['name']}.png",
        "tag": entry["tag"] in {"HR", "LR"},
        "width": type(entry["width"]) is int and 0 < entry["width"] <= _MAX_SIDE,
        "height": type(entry["height"]) is int and 0 < entry["height"] <= _MAX_SIDE,
        "rho": type(rho) in {int, float} and 0 < rho <= 1,
        "K": _is_intrinsics(_matrix(entry["K"], 3)),
        "viewmat": _is_rigid(_matrix(entry["viewmat"], 4)),
    }
    return next((name for name, valid in rules.items() if not valid), "")


def _matrix(value: object, side: int) -> NDArray[np.float64] | None:
    """Return a square matrix of JSON; None where it is not one that a camera can have."""
    rows = value if isinstance(value, list) else []
    if len(rows) != side or not all(isinstance(row, list) and len(row) == side for row in rows):
        return None
    numbers = [number for row in rows for number in row]
    if not all(type(number) in {int, float} and abs(number) <= _MAX_NUMBER for number in numbers):
        return None
    return np.array(rows, dtype=np.float64)


def _is_intrinsics(K: NDArray[np.float64] | None) -> bool:
    if K is None or (K[2] != (0, 0, 1)).any():
        return False
    return bool(K[0, 0] > 0 and K[1, 1] > 0 and K[1, 0] == 0)


def _is_rigid(viewmat: NDArray[np.float64] | None) -> bool:
    if viewmat is None or (viewmat[3] != (0, 0, 0, 1)).any():
        return False
    rotation = viewmat[:3, :3]
    return bool(np.abs(rotation @ rotation.T - np.eye(3)).max() < 1e-6)


def _check_pixels(folder: ConfinedPath, content: dict[str, Any]) -> None:
    """Refuse views of more pixels than their files can hold as photographs."""
    pixels = sum(entry["width"] * entry["height"] for entry in content["views"])
    file_bytes = sum(folder.sizes(list(content["files"])).values())
    if pixels > _FREE_PIXELS + _PIXELS_PER_BYTE * file_bytes:
        raise StoreError(
            f"{folder / MANIFEST}: its views have {pixels} pixels, which files of {file_bytes} "
            "bytes can't hold as photographs"
        )


def _assembled(folder: ConfinedPath, content: dict[str, Any]) -> Variant:
    """Read points and report, and make the variant.

    Raises:
        StoreError: Points or report are malformed.
        OSError: A file can't be read.
    """
    file = folder / POINTS
    try:
        with errors_named(file), file.open() as stream:
            arrays = npz.read(stream)
        points, colors = arrays["points"], arrays["colors"]
    except (ValueError, KeyError) as error:
        raise StoreError(f"{file}: not the points of a variant ({error!r:.200})") from error
    if points.dtype != np.float64 or points.shape != (points.size // 3, 3):
        raise StoreError(f"{file}: points are {points.dtype} {points.shape}, not float64 [P, 3]")
    if len(points) < _MIN_POINTS:
        raise StoreError(f"{file}: it has {len(points)} points, at least {_MIN_POINTS} are needed")
    if colors.dtype != np.uint8 or colors.shape != points.shape:
        raise StoreError(f"{file}: colors are {colors.dtype} {colors.shape}, not those of points")
    if not (np.abs(points) <= _MAX_NUMBER).all():
        raise StoreError(f"{file}: a point is not finite, or is beyond {_MAX_NUMBER:g}")
    views = tuple(_view_from_json(folder, entry) for entry in content["views"])
    report = read_object(folder / REPORT)
    scene, factor, held_out = content["scene"], content["factor"], content["held_out"]
    return Variant(content["id"], folder, scene, factor, held_out, views, points, colors, report)


def _view_to_json(folder: ConfinedPath, view: View) -> dict[str, Any]:
    file = view.file.relative_to(folder)
    arrays = {"K": view.K.tolist(), "viewmat": view.viewmat.tolist()}
    return vars(view) | {"file": file} | arrays


def _view_from_json(folder: ConfinedPath, entry: dict[str, Any]) -> View:
    arrays = {name: np.array(entry[name], dtype=np.float64) for name in ("K", "viewmat")}
    return View(**(entry | {"file": folder / entry["file"], "rho": float(entry["rho"])} | arrays))
