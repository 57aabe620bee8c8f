"""A variant on disk: built once, frozen, hashed, shared by every cell.

A folder named by its id has `variant.json` (what `Variant` holds, and the hash of every other
file), `images/<split>/<view>.png`, `points.npz`, `report.json` (how SfM went) and `colmap.log`.
Nothing here imports torch before a variant is built, so that a plan can read it.
"""

from __future__ import annotations

import fcntl
import logging
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from xrgs.capture import scenes, split
from xrgs.capture.views import SceneFailed, Variant, View
from xrgs.errors import XrgsError
from xrgs.safeio import npz, untrusted
from xrgs.safeio.atomic import write_json
from xrgs.safeio.hashing import digest, file_digest, source_digests
from xrgs.safeio.records import FAILED, failed_scenes

if TYPE_CHECKING:
    from xrgs.config import SceneConf, VariantConf

_log = logging.getLogger(__name__)

_SPLITS = frozenset({"train", "test", "original"})

#: Their code decides what a variant is: a change of it makes a new one.
_CODE = (
    *(
        f"capture/{name}.py"
        for name in (
            "alignment",
            "degrade",
            "images",
            "mixing",
            "photographs",
            "placing",
            "sfm",
            "split",
            "tagging",
            "variant",
            "views",
        )
    ),
)


class CorruptVariant(XrgsError):  # noqa: N818
    """A frozen variant that is not what was written; the message names the file."""


def key(scene: SceneConf, conf: VariantConf) -> str:
    """What a variant is made from, 16 hex digits: photographs, variant config, code. No SfM is run.

    Raises:
        XrgsError: the photographs are not there.
    """
    return _key(scenes.fingerprint(scene, conf.long_side), conf)


def find(variants: Path, wanted: str) -> Variant | None:
    """The frozen variant of a key, verified; a corrupt one is reported and passed over."""
    for folder in sorted(variants.glob(f"{wanted}-*")):
        try:
            return load(folder)
        except CorruptVariant as error:
            _log.warning("%s; the variant will be built anew", error)
    return None


def failure(variants: Path, wanted: str) -> str | None:
    """Why the scene of a key failed when it was last tried; None where it did not.

    The key has the photographs, the config and the code: of others, this says nothing.
    """
    found = failed_scenes(variants, wanted)
    return found[wanted][1] if found else None


def load(folder: Path) -> Variant:
    """A frozen variant, after checking every hash.

    Raises:
        CorruptVariant: a file is missing, or is not the one that was frozen.
    """
    try:
        content = untrusted.parse_json(untrusted.read_bytes(folder / "variant.json"))
        if content["id"] != _id(content):
            raise CorruptVariant(f"{folder / 'variant.json'}: not what was written")
        for name, expected in content["files"].items():
            if not untrusted.is_inside(name) or _digest(folder, name) != expected:
                raise CorruptVariant(f"{folder / name}: not what was written")
        with untrusted.open_regular(folder / "points.npz") as stream:
            stored = npz.read(stream)
        report = untrusted.parse_json(untrusted.read_bytes(folder / "report.json"))
        found = Variant(
            content["id"],
            folder,
            content["scene"],
            content["factor"],
            content["held_out"],
            tuple(_view(folder, entry) for entry in content["views"]),
            stored["points"],
            stored["colors"],
            report,
        )
        _check(found, content["files"])
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise CorruptVariant(f"{folder}: not a whole variant ({error!r})") from error
    return found


def _check(found: Variant, files: dict[str, str]) -> None:
    """That values are of their kinds, and names name what is in the folder alone.

    Raises:
        ValueError: says what is not.
    """
    views, points, colors = found.views, found.points, found.colors
    names = {(view.split, view.name) for view in views}
    rules = {
        "id": untrusted.is_name(found.id),
        "scene, factor or report": isinstance(found.scene, str)
        and type(found.factor) is int
        and found.factor >= 1
        and isinstance(found.report, dict),
        "points": points.shape == (len(points), 3)
        and points.dtype == np.float64
        and bool(np.isfinite(points).all()),
        "colors": colors.shape == points.shape and colors.dtype == np.uint8,
        "two views of one name": len(names) == len(views),
    } | {
        f"view {view.name!r:.80}": untrusted.is_name(view.name)
        and view.file.relative_to(found.path).as_posix() in files
        and view.split in _SPLITS
        and view.tag in {"HR", "LR"}
        and all(type(side) is int and side > 0 for side in (view.width, view.height))
        and view.K.shape == (3, 3)
        and view.viewmat.shape == (4, 4)
        and bool(np.isfinite([*view.K.flat, *view.viewmat.flat, view.rho]).all())
        for view in views
    }
    if wrong := [what for what, right in rules.items() if not right]:
        raise ValueError(wrong[0])


def build(scene: SceneConf, conf: VariantConf, variants: Path, cache: Path) -> Variant:
    """The variant of a scene: the frozen one, or made now. Any number of processes may ask.

    Args:
        scene: Where the photographs are from.
        conf: What is made of them.
        variants: Folder of frozen variants.
        cache: Folder of rendered scenes.

    Raises:
        SceneFailed: SfM can't place enough views; its report stays in `variants/failed-<key>`.
        XrgsError: something of the config or the photographs is wrong; the message names it.
    """
    split.check(conf)
    wanted = key(scene, conf)
    variants.mkdir(parents=True, exist_ok=True)
    report = variants / f"{FAILED}{wanted}" / "report.json"
    before = _written(report)
    with _locked(variants / f".{wanted}.lock"):
        found = find(variants, wanted)
        if found is not None:
            return found
        reason = failure(variants, wanted)
        if reason and _written(report) != before:  # tried by another process while we waited
            raise SceneFailed(f"{reason} Report: {report}", {})
        for corrupt in variants.glob(f"{wanted}-*"):
            untrusted.remove(corrupt)
        resolved = scenes.resolve(scene, cache, conf.long_side)
        return _make(resolved, conf, wanted, variants)


def _written(file: Path) -> int | None:
    try:
        return file.stat().st_mtime_ns
    except OSError:
        return None


def _make(scene: scenes.Scene, conf: VariantConf, wanted: str, variants: Path) -> Variant:
    """Mix and freeze; whatever a killed process left of it is cleared first."""
    from xrgs.capture import mixing

    work, failed = variants / f".{wanted}.building", variants / f"{FAILED}{wanted}"
    untrusted.remove(work)
    untrusted.remove(failed)
    frozen = work / "frozen"
    frozen.mkdir(parents=True)
    try:
        return _freeze(mixing.mix(scene, conf, work, frozen), wanted, frozen, variants)
    except SceneFailed as error:
        write_json(frozen / "report.json", error.report | {"reason": str(error)})
        frozen.rename(failed)
        raise SceneFailed(f"{error} Report: {failed}", error.report) from None
    finally:
        shutil.rmtree(work, ignore_errors=True)


def _freeze(made: Variant, wanted: str, folder: Path, variants: Path) -> Variant:
    """Write what `made` holds beside its images, and rename the folder to its id."""
    np.savez(folder / "points.npz", points=made.points, colors=made.colors)
    write_json(folder / "report.json", made.report)
    files = [folder / "points.npz", *sorted({view.file for view in made.views})]
    content: dict[str, Any] = {
        "key": wanted,
        "scene": made.scene,
        "factor": made.factor,
        "held_out": made.held_out,
        "views": [_entry(folder, view) for view in made.views],
        "files": {f.relative_to(folder).as_posix(): file_digest(f) for f in files},
    }
    content["id"] = _id(content)
    write_json(folder / "variant.json", content)
    home = variants / content["id"]
    folder.rename(home)
    return load(home)


def _key(fingerprint: str, conf: VariantConf) -> str:
    return digest([fingerprint, asdict(conf), source_digests(*_CODE)])


def _id(content: dict[str, Any]) -> str:
    """Hash of everything in `variant.json` but the id and the label, after the key."""
    hashed = {k: v for k, v in content.items() if k not in ("id", "scene")}
    return f"{content['key']}-{digest(hashed)}"


def _entry(folder: Path, view: View) -> dict[str, Any]:
    file = view.file.relative_to(folder).as_posix()
    arrays = {"K": view.K.tolist(), "viewmat": view.viewmat.tolist()}
    return asdict(view) | {"file": file} | arrays


def _digest(folder: Path, name: str) -> str:
    """Hash of a file in the folder itself: a link, to a file or on the way to it, has none.

    Raises:
        OSError: it is not there.
    """
    file = folder / name
    return file_digest(file) if file.resolve() == folder.resolve() / name else ""


def _view(folder: Path, entry: dict[str, Any]) -> View:
    arrays = {name: np.array(entry[name], dtype=np.float64) for name in ("K", "viewmat")}
    return View(**(entry | {"file": folder / entry["file"]} | arrays))


@contextmanager
def _locked(file: Path) -> Iterator[None]:
    """Hold an exclusive lock; the system lets go of it if this process dies."""
    # Never through a link, which would have another file emptied.
    with os.fdopen(os.open(file, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o666), "w") as handle:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            _log.warning("another process is building this variant: waiting for it")
            fcntl.flock(handle, fcntl.LOCK_EX)
        yield
