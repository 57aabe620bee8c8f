"""Builds, freezes, finds and loads variants on disk; cells share them.

A variant is a folder named by its id: `variant.json` holds the fields of `Variant` and the hash of
every other file that decides a number, `images/<split>/<view>.png` the images, `points.npz` the SfM
points, `report.json` how SfM went, and `colmap.log` COLMAP's log. Nothing here imports torch before
a variant is built, so that a plan can read variants.
"""

from __future__ import annotations

import fcntl
import logging
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from xrgs.capture import scenes, split
from xrgs.capture.failures import FAILED_PREFIX, failed_scenes
from xrgs.capture.views import SceneFailed, Variant, View
from xrgs.errors import StoreError, UnreadableError, XrgsError
from xrgs.safeio import npz, untrusted
from xrgs.safeio.atomic import atomic_writer, write_json
from xrgs.safeio.confined import ConfinedPath, confined, is_passing
from xrgs.safeio.hashing import digest, file_digest, source_digests
from xrgs.safeio.records import read_object

if TYPE_CHECKING:
    from xrgs.config import SceneConf, VariantConf

_log = logging.getLogger(__name__)

_SPLITS = frozenset({"train", "test", "original"})

#: The source files that decide what a variant is: a change in one of them changes every key.
_SOURCES = (
    "capture/alignment.py",
    "capture/degrade.py",
    "capture/images.py",
    "capture/lens.py",
    "capture/mixing.py",
    "capture/photographs.py",
    "capture/registration.py",
    "capture/sfm.py",
    "capture/split.py",
    "capture/tagging.py",
    "capture/variant.py",
    "capture/views.py",
)


class CorruptVariant(XrgsError):  # noqa: N818
    """A frozen variant is damaged or was changed; the message names the file."""


def key(scene: SceneConf, conf: VariantConf) -> str:
    """Hash what a variant is made from: photographs, variant config and code, without running SfM.

    Args:
        scene: The scene's config.
        conf: The variant's config.

    Returns:
        16 hexadecimal digits.

    Raises:
        XrgsError: The photographs are not there.
    """
    fingerprint = scenes.fingerprint(scene, conf.long_side)
    return digest([fingerprint, asdict(conf), source_digests(*_SOURCES)])


def find(variants: Path | ConfinedPath, wanted_key: str) -> Variant | None:
    """Find the frozen variant of a key, and verify it; a corrupt one is logged and passed over.

    Args:
        variants: The store's folder of variants.
        wanted_key: What `key` gives.

    Returns:
        The variant; None where there is no intact one.
    """
    for folder in _of_key(confined(variants), wanted_key):
        try:
            return load(folder)
        except CorruptVariant as error:
            _log.warning("%s; the variant will be built anew", error)
    return None


def _of_key(variants: ConfinedPath, wanted_key: str) -> list[ConfinedPath]:
    """Return the folders of the variants of a key."""
    try:
        return [variants / name for name in variants.names() if name.startswith(f"{wanted_key}-")]
    except FileNotFoundError:
        return []


def failure(variants: Path | ConfinedPath, wanted_key: str) -> str | None:
    """Read why the scene of a key could not be made into a variant when it was last tried.

    Args:
        variants: The store's folder of variants.
        wanted_key: What `key` gives. It covers photographs, config and code, so that a failure says
            nothing about any others.

    Returns:
        The reason; None where the key did not fail.
    """
    try:
        failed = failed_scenes(variants, wanted_key)
    except FileNotFoundError:
        return None
    return failed[wanted_key][1] if failed else None


def load(path: Path | ConfinedPath) -> Variant:
    """Load a frozen variant, after every hash is verified.

    Args:
        path: The variant's folder, which may come from anybody.

    Returns:
        The variant.

    Raises:
        CorruptVariant: A file is missing, or is not the one that was frozen.
    """
    folder = confined(path)
    try:
        content = read_object(folder / "variant.json")
        if content["id"] != _id(content):
            raise CorruptVariant(f"{folder / 'variant.json'}: it has changed since it was frozen")
        for name, expected in content["files"].items():
            if not untrusted.is_inside(name) or file_digest(folder / name) != expected:
                raise CorruptVariant(f"{folder}/{name}: it has changed since it was frozen")
        with (folder / "points.npz").open() as stream:
            arrays = npz.read(stream)
        report = read_object(folder / "report.json")
        variant = Variant(
            content["id"],
            folder,
            content["scene"],
            content["factor"],
            content["held_out"],
            tuple(_view_from_json(folder, entry) for entry in content["views"]),
            arrays["points"],
            arrays["colors"],
            report,
        )
        _check(variant, content["files"])
    except UnreadableError:
        raise
    except OSError as error:
        kind = UnreadableError if is_passing(error) else CorruptVariant
        raise kind(f"{error.filename}: {error.strerror}") from error
    except (StoreError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise CorruptVariant(f"{folder}: not a complete variant ({error!r})") from error
    return variant


def _check(variant: Variant, files: dict[str, str]) -> None:
    """Check that values have their types, and that all files are in the variant's folder.

    Raises:
        ValueError: A value is wrong; the message names it.
    """
    views, points, colors = variant.views, variant.points, variant.colors
    names = {(view.split, view.name) for view in views}
    rules = {
        "id": untrusted.is_name(variant.id),
        "scene, factor or report": isinstance(variant.scene, str)
        and type(variant.factor) is int
        and variant.factor >= 1
        and isinstance(variant.report, dict),
        "points": points.shape == (len(points), 3)
        and points.dtype == np.float64
        and bool(np.isfinite(points).all()),
        "colors": colors.shape == points.shape and colors.dtype == np.uint8,
        "two views of one name": len(names) == len(views),
    } | {
        f"view {view.name!r:.80}": untrusted.is_name(view.name)
        and view.file.relative_to(variant.folder) in files
        and view.split in _SPLITS
        and view.tag in {"HR", "LR"}
        and all(type(side) is int and side > 0 for side in (view.width, view.height))
        and view.K.shape == (3, 3)
        and view.viewmat.shape == (4, 4)
        and bool(np.isfinite([*view.K.flat, *view.viewmat.flat, view.rho]).all())
        for view in views
    }
    if wrong := [what for what, valid in rules.items() if not valid]:
        raise ValueError(wrong[0])


def build(
    scene: SceneConf,
    conf: VariantConf,
    variants: Path | ConfinedPath,
    cache: Path | ConfinedPath,
) -> Variant:
    """Find the variant of a scene, or make it; any number of processes may call this at once.

    Args:
        scene: The scene's config.
        conf: The variant's config.
        variants: The store's folder of variants; it is made where it is missing.
        cache: The folder of rendered scenes.

    Returns:
        The frozen variant.

    Raises:
        SceneFailed: SfM can't register enough views; its report is in `variants/failed-<key>`.
        XrgsError: The config or the photographs are not usable; the message names what is wrong.
    """
    split.check_variant_conf(conf)
    wanted_key = key(scene, conf)
    home = confined(variants)
    home.make_folder()
    report = home / f"{FAILED_PREFIX}{wanted_key}" / "report.json"
    report_before = _modified_ns(report)
    with _lock(home / f".{wanted_key}.lock"):
        found = find(home, wanted_key)
        if found is not None:
            return found
        reason = failure(home, wanted_key)
        if reason and _modified_ns(report) != report_before:  # another process tried meanwhile
            raise SceneFailed(f"{reason} Report: {report}", {})
        for corrupt in _of_key(home, wanted_key):
            corrupt.remove()
        resolved = scenes.resolve(scene, confined(cache), conf.long_side)
        return _make(resolved, conf, wanted_key, home)


def _modified_ns(file: ConfinedPath) -> int | None:
    try:
        return file.lstat().st_mtime_ns
    except FileNotFoundError:
        return None


def _make(
    scene: scenes.Scene, conf: VariantConf, wanted_key: str, variants: ConfinedPath
) -> Variant:
    """Make and freeze a variant, after what a killed process left of it is removed."""
    from xrgs.capture import mixing

    work = variants / f".{wanted_key}.building"
    failed = variants / f"{FAILED_PREFIX}{wanted_key}"
    work.remove()
    failed.remove()
    frozen = work / "frozen"
    frozen.make_folder()
    try:
        made = mixing.mix_resolutions(scene, conf, work.path, frozen)
        return _freeze(made, wanted_key, frozen, variants)
    except SceneFailed as error:
        write_json(frozen / "report.json", error.report | {"reason": str(error)})
        frozen.rename(failed)
        raise SceneFailed(f"{error} Report: {failed}", error.report) from None
    finally:
        with suppress(OSError):
            work.remove()


def _freeze(
    made: Variant, wanted_key: str, folder: ConfinedPath, variants: ConfinedPath
) -> Variant:
    """Write a variant's fields into the folder of its images, and rename the folder to its id."""
    with atomic_writer(folder / "points.npz") as stream:
        np.savez(stream, points=made.points, colors=made.colors)
    write_json(folder / "report.json", made.report)
    files = [folder / "points.npz", *sorted({view.file for view in made.views})]
    content: dict[str, Any] = {
        "key": wanted_key,
        "scene": made.scene,
        "factor": made.factor,
        "held_out": made.held_out,
        "views": [_view_to_json(folder, view) for view in made.views],
        "files": {f.relative_to(folder): file_digest(f) for f in files},
    }
    content["id"] = _id(content)
    write_json(folder / "variant.json", content)
    folder.sync_tree()
    home = variants / content["id"]
    folder.rename(home)
    home.sync_name()
    return load(home)


def _id(content: dict[str, Any]) -> str:
    """Compute the id: the key, then a hash of all of `variant.json` but the id and the label."""
    hashed = {k: v for k, v in content.items() if k not in ("id", "scene")}
    return f"{content['key']}-{digest(hashed)}"


def _view_to_json(folder: ConfinedPath, view: View) -> dict[str, Any]:
    file = view.file.relative_to(folder)
    arrays = {"K": view.K.tolist(), "viewmat": view.viewmat.tolist()}
    return vars(view) | {"file": file} | arrays


def _view_from_json(folder: ConfinedPath, entry: dict[str, Any]) -> View:
    arrays = {name: np.array(entry[name], dtype=np.float64) for name in ("K", "viewmat")}
    return View(**(entry | {"file": folder / entry["file"]} | arrays))


@contextmanager
def _lock(file: ConfinedPath) -> Iterator[None]:
    """Hold an exclusive lock; the system releases it where this process dies."""
    with file.append() as handle:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            _log.warning("another process is building this variant: waiting for it")
            fcntl.flock(handle, fcntl.LOCK_EX)
        yield
