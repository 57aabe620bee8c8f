"""Finds the frozen variant of a config in the store, or builds it in a process of its own."""

from __future__ import annotations

import shlex
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from xrgs.capture import photographs, scenes, split, variant
from xrgs.capture.description import read_report
from xrgs.capture.folders import failed_folder, trimmed_folder
from xrgs.config import CONF_DIR
from xrgs.errors import StoreError, UnreadableError, XrgsError
from xrgs.experiment import trimming
from xrgs.experiment.store import StoreGoneError
from xrgs.runtime.progress import log_line
from xrgs.safeio.files import is_transient
from xrgs.sweep.jobs import worker
from xrgs.sweep.jobs.supervise import Limits

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from xrgs.config import Conf, SceneConf
    from xrgs.experiment.store import Store


@dataclass(frozen=True)
class PlannedVariant:
    """The variant of a config, for the plan of a sweep; without values while it is not built."""

    id: str | None = None
    error: str | None = None
    """Why no variant can be made of the scene."""
    remembered: bool = False
    """Whether the store keeps the error, so that only `retry=failed` tries the scene again."""
    unknown: str | None = None
    """The file that can't be read now."""
    notes: tuple[str, ...] = ()
    """What its report says, or in a dry run what the report of a new variant would say."""


def build(conf: Conf, store: Store, place: str = "") -> str:
    """Build the variant of a config in a child process, and return its id.

    Args:
        conf: A cell's config, of which only scene and variant are read.
        store: The store to build it in.
        place: Which of a sweep's variants it is, for the log.

    Raises:
        UnwritableError: The disk is full or can't be written.
        UnreadableError: A file can't be read now.
        StoreGoneError: The store is no longer there.
        XrgsError: The photographs are missing, or can't be made into a variant.
    """
    _check_held_out(scenes.names(conf.scene, conf.variant.long_side), conf)  # SfM takes minutes
    log_line(f"{scenes.label(conf.scene)}: building the mixed-resolution variant{place}")
    request = {"conf": asdict(conf), "store": str(store.path)}
    answer = worker.run_in_child("variant", request, Limits(), lambda _: store.check_not_gone())
    return str(answer["variant"])


def restore(conf: Conf, store: Store, variant_id: str) -> None:
    """Make the images of a trimmed variant again, in a child process.

    Args:
        conf: The config of a cell of the variant, of which only scene and variant are read.
        store: The store.
        variant_id: The variant's id. A variant that is not trimmed is left as it is.

    Raises:
        UnwritableError: The disk is full or can't be written.
        UnreadableError: A file can't be read now.
        StoreGoneError: The store is no longer there.
        XrgsError: The photographs are missing, or give other images.
    """
    if not trimmed_folder(store.variants, variant_id).is_dir():
        return
    log_line(f"variant {variant_id}: making the images again that xrgs-store trim has removed")
    request = {"conf": asdict(conf), "store": str(store.path), "variant": variant_id}
    worker.run_in_child("restore", request, Limits(), lambda _: store.check_not_gone())


def how_to_get(scenes: Iterable[SceneConf]) -> str:
    """Return how to get scenes of `conf/scene` whose photographs are missing; empty if none are."""
    from omegaconf import OmegaConf

    absent: dict[str, Path] = {}
    for scene in scenes:
        path = Path(scene.path or "")
        if path.name == scene.name and not path.exists():
            absent[scene.name] = path
    missing: dict[tuple[str, Path], list[str]] = {}
    for file in sorted((CONF_DIR / "data").glob("*.yaml")):
        published = OmegaConf.load(file).scenes
        for name, path in absent.items():
            if name in published:
                missing.setdefault((file.stem, path.parent), []).append(name)
    usual = Path(OmegaConf.load(CONF_DIR / "config.yaml").data_root)
    commands = [
        f"xrgs-data download {dataset} {' '.join(names)}"
        + ("" if root == usual else f" --data-root {shlex.quote(str(root))}")
        for (dataset, root), names in missing.items()
    ]
    hints = [f"to download what is missing: {'; '.join(commands)}"] if commands else []
    captures = {file.stem for file in (CONF_DIR / "scene/captures").glob("*.yaml")}
    if own := [str(path) for name, path in absent.items() if name in captures]:
        hints.append(
            "no command downloads the captures: docs/study.md says where their photographs are from"
            f" (section Scenes); they belong into {', '.join(own)}"
        )
    return "\n".join(hints)


def find_or_build(conf: Conf, store: Store) -> str:
    """Return the id of the frozen variant of a config, and build it if the store lacks it.

    Raises:
        XrgsError: The photographs are missing, or can't be made into a variant.
    """
    if hint := how_to_get([conf.scene]):
        raise XrgsError(f"scene.path={conf.scene.path}: no such folder; {hint}")
    frozen = variant.find(store.variants, variant.key(conf.scene, conf.variant))
    if frozen is not None:
        return frozen.id
    store.prepare()
    return build(conf, store)


def plan(conf: Conf, store: Store, *, allow_build: bool, place: str = "") -> PlannedVariant:
    """Return a config's variant for a sweep, or the reason why there is none.

    A scene that failed before is not tried again, like a failed cell, unless `retry=failed`.

    Args:
        conf: A cell's config.
        store: The store.
        allow_build: Build the variant if the store lacks it; False for a dry run.
        place: Which of the sweep's variants it is, for the log.

    Raises:
        StoreError: The store can't be written, or is no longer there.
    """
    try:
        return _find_or_build(conf, store, allow_build=allow_build, place=place)
    except worker.UnwritableError as error:
        raise StoreError(f"store={store.path}: {error}. {worker.NOTHING_LOST}") from error
    except StoreGoneError:
        raise
    except UnreadableError as error:
        reason = str(error)
    except OSError as error:
        if not is_transient(error):
            raise
        reason = str(error)
    return PlannedVariant(unknown=f"its variant can't be read now: {reason}")


def _find_or_build(conf: Conf, store: Store, *, allow_build: bool, place: str) -> PlannedVariant:
    key = None
    try:
        key = variant.key(conf.scene, conf.variant)
        frozen = variant.find(store.variants, key)
        if frozen is not None:
            return _found(conf, store, frozen.id, store.variants / frozen.id)
        # The done cells of a trimmed variant are found by its id; a job that trains another cell
        # makes the images again.
        if trimmed := trimming.trimmed_variant(store.variants, key):
            return _found(conf, store, trimmed, trimmed_folder(store.variants, trimmed))
        failure = None if conf.retry == "failed" else variant.failure(store.variants, key)
        if failure:
            notes = _notes(failed_folder(store.variants, key))
            return PlannedVariant(error=failure, remembered=True, notes=notes)
        # Not before a build: a header may be of a file that can't be decoded, and is left out.
        if allow_build:
            built = build(conf, store, place)
            return PlannedVariant(built, notes=_notes(store.variants / built))
        return PlannedVariant(notes=_expected_notes(conf, store))
    except (UnreadableError, worker.UnwritableError, StoreGoneError):
        raise
    except XrgsError as error:
        if allow_build:
            store.check_not_gone()
            # COLMAP dies of a full disk without saying so. The scene is not at fault then.
            store.check_room()
        # The reason that the store keeps: a sweep that is planned again has the same record then.
        remembered = variant.failure(store.variants, key) if key else None
        notes = _notes(failed_folder(store.variants, key)) if key and remembered else ()
        return PlannedVariant(
            error=remembered or str(error), remembered=remembered is not None, notes=notes
        )


def _found(conf: Conf, store: Store, variant_id: str, folder: Path) -> PlannedVariant:
    """Return a variant that was built before, with the notes of its report.

    Files that came into the scene's folder since then, as a store, are left out and said too.
    """
    now = _scene(conf, store).notes if conf.scene.kind == "folder" else ()
    return PlannedVariant(variant_id, notes=tuple(dict.fromkeys((*now, *_notes(folder)))))


def _scene(conf: Conf, store: Store) -> scenes.Scene:
    """List the photographs of a folder."""
    return scenes.resolve(conf.scene, store.scenes, conf.variant.long_side)


def _notes(folder: Path) -> tuple[str, ...]:
    """Return what the report of a variant, or of a scene that failed, says of its photographs.

    Raises:
        UnreadableError: The report can't be read now.
    """
    try:
        return read_report(folder).all_notes()
    except UnreadableError:
        raise
    except StoreError as error:
        return (str(error),)


def _expected_notes(conf: Conf, store: Store) -> tuple[str, ...]:
    """Say what a variant of photographs would leave out, from their names and headers alone.

    Raises:
        UnreadableError: A photograph can't be read now.
        XrgsError: No variant can be made, even if SfM places every photograph.
    """
    names = scenes.names(conf.scene, conf.variant.long_side)
    sizes, notes = [(1, 1)] * len(names), list[str]()  # other kinds make views of one size
    if conf.scene.kind == "folder":
        scene = _scene(conf, store)
        photos = photographs.expected_photographs(scene, conf.variant)
        names, sizes = photos.names, [photo.size for photo in photos.all]
        notes = [*scene.notes, *photos.notes]
    _check_held_out(names, conf, notes)
    parts = split.split_before_sfm(names, sizes, conf.variant)
    return *notes, *split.split_notes(parts, conf.variant)


def _check_held_out(names: Sequence[str], conf: Conf, notes: Iterable[str] = ()) -> None:
    """Refuse photographs of which too few are trained on, or none tested, even if all are placed.

    Args:
        names: The names of the photographs, sorted. Some may turn out to be unreadable, and leave
            even fewer.
        conf: A cell's config.
        notes: What else is said of the photographs.

    Raises:
        XrgsError: There are too few; the message says what helps.
    """
    parts = split.split_views(names, conf.variant)
    lacking = split.shortage(parts, set(range(len(names))), conf.variant)
    if not lacking:
        return
    held_out = len(parts.test)
    which = f"{held_out} of {len(names)} photographs {'is' if held_out == 1 else 'are'} held out"
    helps = "variant.test_every=0 (tests are then on the training views)"
    if conf.variant.test:
        helps = "name fewer or others in variant.test"
    where = f"scene {scenes.label(conf.scene)}"
    raise XrgsError(
        "; ".join([f"{where}: {lacking}. {which}: {helps}, or add photographs", *notes])
    )
