"""Finds the frozen variant of a config in the store, or builds it in a process of its own."""

from __future__ import annotations

import shlex
import threading
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import suppress
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import TypeVar

from xrgs.config import CONF_DIR, Conf, SceneConf, VariantConf
from xrgs.errors import StoreError, UnreadableError, XrgsError
from xrgs.mixture import photographs, split, variant
from xrgs.mixture.degradations import DEGRADATIONS, resolve_degradation
from xrgs.mixture.paths import failed_folder, trimmed_folder
from xrgs.photos import scenes
from xrgs.photos.scenes.scene import ALL_BELOW
from xrgs.runtime.machine import usable_cores, usable_memory
from xrgs.runtime.progress import log_line
from xrgs.safeio.files import is_transient
from xrgs.safeio.paths import user_path
from xrgs.safeio.sanitize import counted
from xrgs.store import trimming
from xrgs.store.inspect import read_report
from xrgs.store.store import Store, StoreGoneError
from xrgs.sweep import job

_Result = TypeVar("_Result")
#: Memory that a build may take; fern and flower take 0.6 GB each at 500 px.
_BUILD_BYTES = 2 << 30


@dataclass(frozen=True)
class PlannedVariant:
    """The variant of a config, for the plan of a sweep; without values while it is not built."""

    id: str | None = None
    error: str | None = None
    """Why no variant can be made of the scene."""
    remembered: bool = False
    """Whether the store keeps the error, so that only `retry=failed` tries the scene again."""
    notes: tuple[str, ...] = ()
    """The notes of its report; in a dry run, the notes that a new variant's report would have."""


def build(
    conf: Conf,
    store: Store,
    place: str = "",
    is_over: Callable[[], bool] = lambda: False,
    environment: Mapping[str, str] = MappingProxyType({}),
) -> str:
    """Build the variant of a config in a child process, and return its id.

    A message tells the `place` among several builds. The child is ended when `is_over`, and has the
    variables of `environment` besides those of this process. WorkError says that the build failed,
    or the disk is full or can't be written.
    """

    def on_poll(_: int) -> None:
        store.check_not_gone()
        if is_over():
            raise job.WorkError("the sweep has ended", job.STOPPED)

    _check_held_out(scenes.names(conf.scene, conf.variant.long_side), conf)  # SfM takes minutes
    work = "building the mixed-resolution variant"
    if resolve_degradation(conf.variant) == "none":
        work = "finding the cameras" if conf.variant.poses is None else "reading the cameras"
    log_line(f"{scenes.label(conf.scene)}: {work}{place}{_not_read(conf)}")
    request = {"conf": asdict(conf), "store": str(store.path)}
    answer = job.run_in_child("variant", request, None, on_poll, environment)
    return str(answer["variant"])


def _not_read(conf: Conf) -> str:
    """Say which word reads the cameras beside the photographs; empty without such cameras.

    Other programs read them unasked. Here a folder has the same cameras with and without them.
    """
    from xrgs.mixture.poses import colmap, transforms

    if conf.scene.kind != "folder" or conf.variant.poses is not None:
        return ""
    folder = user_path(str(conf.scene.path).removesuffix(ALL_BELOW))
    for root in (folder, folder.parent) if folder.name == "images" else (folder,):
        with suppress(OSError, XrgsError):
            if files := transforms.in_folder(root) or colmap.files(root):
                word = shlex.quote(f"variant.poses={files[0].parent}")
                return f"; {word} takes those that are there"
    return ""


def how_to_get(scenes: Iterable[SceneConf]) -> str:
    """Return how to get scenes of `conf/scene` whose photographs are missing; empty if none are."""
    from omegaconf import OmegaConf

    absent: dict[str, Path] = {}
    for scene in scenes:
        path = Path(scene.path or "")
        if path.name == scene.name and not path.exists():
            absent[scene.name] = path
    near = {name: root for name, path in absent.items() if (root := _root_near(path))}
    hints = [f"{root}/{name} is there: data_root={root}" for name, root in near.items()]
    absent = {name: path for name, path in absent.items() if name not in near}
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
    hints += [f"to download what is missing: {'; '.join(commands)}"] if commands else []
    captures = {file.stem for file in (CONF_DIR / "scene/captures").glob("*.yaml")}
    if folders := [str(path) for name, path in absent.items() if name in captures]:
        hints.append(
            "no command downloads the captures: docs/study.md says where their photographs are from"
            f" (section Scenes); they belong into {', '.join(folders)}"
        )
    return "\n".join(hints)


def _root_near(missing: Path) -> str:
    """Return the right `data_root`, a level below or above a wrong one; empty if there is none."""
    root, name = missing.parent, missing.name
    roots = [folder.parent for folder in sorted(root.glob(f"*/{name}")) if folder.is_dir()]
    roots += [root.parent] if root.name == name and root.is_dir() else []
    return shlex.quote(str(roots[0])) if roots else ""


def plan(confs: Sequence[Conf], store: Store, *, allow_build: bool) -> list[PlannedVariant]:
    """Return the variants of configs for a sweep, or the reasons why there are none.

    The variants that the store lacks are built, several at once, unless `allow_build` is False, as
    in a dry run. A scene that failed before is not tried again, like a failed cell, unless
    `retry=failed`. StoreError says that the store can't be written, or is no longer there.
    """
    stored = [_outcome(_stored_variant, conf, store) for conf in confs]
    lacking = {i: confs[i] for i, planned in enumerate(stored) if planned is None}
    if allow_build and lacking:
        store.prepare()
        new = _build_all(lacking, len(confs), store)
    else:  # not before a build, which leaves out files that have a header and can't be decoded
        new = {i: _outcome(_expected_variant, conf, store) for i, conf in lacking.items()}
    return [planned or new[i] for i, planned in enumerate(stored)]


def _stored_variant(conf: Conf, store: Store) -> PlannedVariant | None:
    """Return a config's variant, or its failure, from the store; None where it is to be built."""
    key = variant.key(conf.scene, conf.variant)
    frozen = variant.find(store.variants, key)
    if frozen is not None:
        return _with_notes(conf, store, frozen.id, store.variants / frozen.id)
    # The done cells of a trimmed variant are found by its id; a job that trains another cell makes
    # the images again.
    if trimmed := trimming.trimmed_variant(store.variants, key):
        return _with_notes(conf, store, trimmed, trimmed_folder(store.variants, trimmed))
    return None if conf.retry == "failed" else _failed_before(store, key)


def _build_all(lacking: Mapping[int, Conf], total: int, store: Store) -> dict[int, PlannedVariant]:
    """Build variants, several at once.

    COLMAP finds the cameras of a scene on one core: a single build would leave the others idle.
    The configs are by their places among all variants of the sweep.
    """
    cores = usable_cores()
    at_once = max(1, min(len(lacking), cores, usable_memory() // _BUILD_BYTES))
    environment = {"PYTHON_CPU_COUNT": str(cores // at_once)}
    if at_once > 1:
        environment["TQDM_DISABLE"] = "1"  # the bars of several builds would overwrite each other
    ended = threading.Event()

    def build_one(i: int, conf: Conf, store: Store) -> PlannedVariant:
        place = f" {i + 1} of {total}" if total > 1 else ""
        built = build(conf, store, place, ended.is_set, environment)
        return PlannedVariant(built, notes=_notes(store.variants / built))

    with ThreadPoolExecutor(at_once) as pool:
        builds = {
            i: pool.submit(_outcome, partial(build_one, i), conf, store, building=True)
            for i, conf in lacking.items()
        }
        try:
            for ending in as_completed(builds.values()):
                ending.result()
        finally:  # an error or a signal ends the other builds
            ended.set()
            pool.shutdown(cancel_futures=True)
    return {i: ending.result() for i, ending in builds.items()}


def _outcome(
    work: Callable[[Conf, Store], _Result], conf: Conf, store: Store, *, building: bool = False
) -> _Result | PlannedVariant:
    """Return what `work` returns for a config, or the reason why the scene has no variant."""
    try:
        return work(conf, store)
    except StoreGoneError:
        raise
    except OSError as error:
        if not is_transient(error):
            raise
        return PlannedVariant(error=str(error))
    except XrgsError as error:
        if isinstance(error, job.WorkError) and error.outcome == job.UNWRITABLE:
            raise StoreError(f"{error}. {job.NOTHING_LOST}") from error
        if building:
            store.check_not_gone()
            # COLMAP dies of a full disk without saying so. The scene is not at fault then.
            store.check_room()
        # The reason that the store keeps: a sweep that is planned again has the same record then.
        with suppress(XrgsError):  # the photographs are not there, or it can't be read now
            if failed := _failed_before(store, variant.key(conf.scene, conf.variant)):
                return failed
        return PlannedVariant(error=str(error))


def _failed_before(store: Store, key: str) -> PlannedVariant | None:
    """Return the failure of a scene that the store keeps; None where there is none."""
    failure = variant.failure(store.variants, key)
    if not failure:
        return None
    notes = _notes(failed_folder(store.variants, key))
    return PlannedVariant(error=failure, remembered=True, notes=notes)


def _with_notes(conf: Conf, store: Store, variant_id: str, folder: Path) -> PlannedVariant:
    """Return a variant that was built before, with the notes of its report.

    Files that have come into the scene's folder since, for example a store, have notes too.
    """
    notes: tuple[str, ...] = ()
    if conf.scene.kind == "folder":
        notes = tuple(scenes.resolve(conf.scene, store.scenes, conf.variant.long_side).notes)
    return PlannedVariant(variant_id, notes=tuple(dict.fromkeys((*notes, *_notes(folder)))))


def _notes(folder: Path) -> tuple[str, ...]:
    """Return the notes on photographs in the report of a variant, or of a scene that failed."""
    try:
        return read_report(folder).all_notes()
    except UnreadableError:
        raise
    except StoreError as error:
        return (str(error),)


def _expected_variant(conf: Conf, store: Store) -> PlannedVariant:
    """Return a variant that a dry run does not build.

    The notes that it would have are from the names and headers of the photographs.

    Raises:
        XrgsError: No variant can be made, even if SfM places every photograph.
    """
    names = scenes.names(conf.scene, conf.variant.long_side)
    sizes, notes = [(1, 1)] * len(names), list[str]()  # other kinds make views of one size
    if conf.scene.kind == "folder":
        scene = scenes.resolve(conf.scene, store.scenes, conf.variant.long_side)
        photos = photographs.expected_photographs(scene, conf.variant)
        names, sizes = photos.names, [photo.size for photo in photos.all]
        notes = [*scene.notes, *photos.notes]
    _check_held_out(names, conf, notes)
    parts = split.split_before_sfm(names, sizes, conf.variant)
    if conf.scene.kind == "folder":
        notes.append(_use_of_photographs(parts, conf.variant))
    return PlannedVariant(notes=(*notes, *split.split_notes(parts, conf.variant)))


def _use_of_photographs(parts: split.Split, conf: VariantConf) -> str:
    """Say how many photographs are held out, trained on, and degraded."""
    trained, tests = len(parts.hr) + len(parts.lr), len(parts.test)
    degradation = resolve_degradation(conf)
    uses = f"{counted(trained + tests, 'photograph')}: {tests} held out, {trained} to train on"
    if degradation == "none" or not parts.lr:
        return f"{uses}, as they are"
    smaller = degradation in DEGRADATIONS and DEGRADATIONS[degradation].smaller
    change = f"made {conf.factor} times smaller" if smaller else f"degraded by {degradation}"
    lr = f"{len(parts.lr)} of which are {change}"
    return f"{uses}, {lr}; variant.hr_fraction=1 leaves them as they are"


def _check_held_out(names: Sequence[str], conf: Conf, notes: Iterable[str] = ()) -> None:
    """Refuse a split with too few photographs to train on, or none to test, even if SfM places all.

    The names are sorted; notes on the photographs are for the end of the message.
    """
    parts = split.split_views(names, conf.variant)
    if not split.shortage(parts, set(range(len(names))), conf.variant):
        return
    held_out, left = len(parts.test), len(parts.hr) + len(parts.lr)
    which = f"{held_out} {'is' if held_out == 1 else 'are'} held out to test on"
    why = f"{which}, and {left} left to train on, which takes two"
    helps = "hold none out: variant.test_every=0, or xrgs-train --all"
    if conf.variant.test:
        helps = "name fewer or others in variant.test"
    few = f"scene {scenes.label(conf.scene)}: {counted(len(names), 'photograph')} are too few"
    raise XrgsError("; ".join([f"{few}: {why}. Add photographs, or {helps}", *notes]))
