"""Finds, builds and freezes variants on disk; cells share them.

`xrgs.mixture.saved_variant` reads and writes the folder of a variant. torch is imported only to
build a variant, so that planning is quick.
"""

from __future__ import annotations

import logging
from contextlib import suppress
from pathlib import Path
from typing import Any

from xrgs.config import SceneConf, VariantConf, identity_values
from xrgs.errors import StoreError, UnreadableError
from xrgs.mixture import paths, poses, split
from xrgs.mixture.degradations import DEGRADATIONS, resolve_degradation
from xrgs.mixture.saved_variant import CorruptVariant, freeze, load, verify
from xrgs.mixture.tags import POLICIES
from xrgs.mixture.views import SceneFailed, Variant
from xrgs.photos import scenes
from xrgs.runtime import lease
from xrgs.safeio import checksums
from xrgs.safeio.atomic import write_json
from xrgs.safeio.code import CodeFolders, code_digest
from xrgs.safeio.files import remove_path
from xrgs.safeio.hashing import digest
from xrgs.safeio.records import list_folder
from xrgs.safeio.refactorings import canonical

__all__ = [
    "CorruptVariant",
    "all_code",
    "build",
    "code",
    "failure",
    "find",
    "key",
    "load",
    "verify",
]

_log = logging.getLogger(__name__)

_DEGRADATIONS, _TAGS = "mixture/degradations", "mixture/tags"
#: The code that makes variants from photographs. Every file counts for every variant, except the
#: code for given poses, degradations and tags: these files count only if the variant uses them.
_CODE = CodeFolders(
    folders=("mixture",),
    whole_parts=("mixture/poses",),
    folders_of_parts=(_DEGRADATIONS, _TAGS),
    parts=frozenset(
        {f"{_DEGRADATIONS}/{name}.py" for name in DEGRADATIONS}
        | {f"{_TAGS}/{name}.py" for name in POLICIES}
    ),
    registries=frozenset({f"{_DEGRADATIONS}/__init__.py", f"{_TAGS}/__init__.py"}),
)


def key(scene: SceneConf, conf: VariantConf) -> str:
    """Hash the photographs, poses, config and code of a variant: 16 digits, without running SfM.

    XrgsError says why the photographs, the poses or the config are not usable.
    """
    split.check_variant_conf(conf)
    split.check_test_names(scenes.names(scene, conf.long_side) if conf.test else (), conf)
    settings = _settings(conf)
    if conf.poses is not None:
        settings["poses"] = poses.fingerprint(conf.poses)
    return digest([scenes.fingerprint(scene, conf.long_side), settings, code(conf)])


def _settings(conf: VariantConf) -> dict[str, Any]:
    """Return the settings that a variant depends on, without those of other degradations."""
    used = resolve_degradation(conf)
    unused = {key for name, way in DEGRADATIONS.items() if name != used for key in way.keys}
    values = {key: value for key, value in identity_values(conf).items() if key not in unused}
    return values | {"degradation": used}


def code(conf: VariantConf) -> dict[str, str]:
    """Return part -> digest, for the code that makes a variant from a scene's photographs.

    The code that provides the photographs is part of the scene's fingerprint instead.
    """
    files = {"core": _CODE.core()}
    if conf.poses is not None:
        files["poses"] = ("mixture/poses",)
    if (name := resolve_degradation(conf)) in DEGRADATIONS:
        files["degradation"] = _CODE.part(f"{_DEGRADATIONS}/{name}.py")
    if conf.tags in POLICIES:
        files["tags"] = _CODE.part(f"{_TAGS}/{conf.tags}.py")
    return {
        part: canonical(f"variant/{part}", code_digest(*names)) for part, names in files.items()
    }


def all_code(scene: SceneConf, conf: VariantConf) -> dict[str, str]:
    """Return `code` with the digest of the code that provides the scene's photographs added."""
    return {"scene": scenes.code_of(scene.kind), **code(conf)}


def find(variants: Path, wanted_key: str) -> Variant | None:
    """Find and verify the frozen variant of a key; log and ignore corrupt variants.

    None if there is no intact one; UnreadableError if one can't be read at the moment, since it may
    be intact.
    """
    for folder in _of_key(variants, wanted_key):
        try:
            return load(folder)
        except CorruptVariant as error:
            _log.warning("%s; the variant will be built anew", error)
    return None


def _of_key(variants: Path, wanted_key: str) -> list[Path]:
    """Return the folders of the variants of a key."""
    return [variants / name for name in list_folder(variants) if name.startswith(f"{wanted_key}-")]


def failure(variants: Path, wanted_key: str) -> str | None:
    """Read why the last attempt to make the variant of a key failed; None if it did not.

    A key depends on photographs, config and code, so a change of any of these is tried again. A
    damaged report counts as no failure; one that can't be read at the moment raises
    UnreadableError.
    """
    folder = paths.failed_folder(variants, wanted_key)
    try:
        return paths.read_failure(folder)[1] if folder.name in list_folder(variants) else None
    except UnreadableError:
        raise
    except StoreError:
        return None


def build(scene: SceneConf, conf: VariantConf, variants: Path, cache: Path) -> Variant:
    """Find the variant of a scene, or make it; several processes may call this concurrently.

    `variants` is the store's folder of variants, which is made if the store exists, and `cache` its
    folder of rendered scenes.

    Raises:
        UnreadableError: The variant exists, but can't be read at the moment; it is not changed.
        SceneFailed: SfM can't register enough views; its report is in `variants/failed-<key>`.
        XrgsError: The config or the photographs are not usable; the message says why.
    """
    wanted_key = key(scene, conf)
    variants.mkdir(exist_ok=True)
    report = paths.failed_folder(variants, wanted_key) / "report.json"
    report_before = _modified_ns(report)
    with lease.waited_for(variants, f".{wanted_key}.lock"):
        found = find(variants, wanted_key)
        if found is not None:
            return found
        reason = failure(variants, wanted_key)
        if reason and _modified_ns(report) != report_before:  # another process tried meanwhile
            raise SceneFailed(f"{reason} Report: {report}", {})
        for corrupt in _of_key(variants, wanted_key):
            _log.warning("%s: renamed to %s", corrupt, checksums.set_aside(corrupt).name)
        resolved = scenes.resolve(scene, cache, conf.long_side)
        return _make(resolved, conf, wanted_key, variants, all_code(scene, conf))


def _modified_ns(file: Path) -> int | None:
    try:
        return file.lstat().st_mtime_ns
    except OSError:
        return None


def _make(
    scene: scenes.Scene,
    conf: VariantConf,
    wanted_key: str,
    variants: Path,
    made_by: dict[str, str],
) -> Variant:
    """Make and freeze a variant; first remove the unfinished work of killed processes."""
    from xrgs.mixture import mixing

    work = variants / f".{wanted_key}.building"
    failed = paths.failed_folder(variants, wanted_key)
    remove_path(work)
    remove_path(failed)
    frozen = work / "frozen"
    for folder in (work, frozen, frozen / "images"):
        folder.mkdir()
    try:
        made = mixing.mix_resolutions(scene, conf, work, frozen)
        return freeze(made, wanted_key, frozen, variants, made_by)
    except SceneFailed as error:
        write_json(frozen / "report.json", error.report | {"reason": str(error)})
        frozen.rename(failed)
        raise SceneFailed(f"{error} Report: {failed}", error.report) from None
    finally:
        with suppress(OSError):
            remove_path(work)
