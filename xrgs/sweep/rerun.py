"""Trains a finished cell again from nothing but its folder, and compares the results.

The cell's config says how to train, and its identity names the variant to train on. Differences of
the program, its libraries and the machine are reported before the training: they explain other
numbers.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec

from xrgs import composing
from xrgs.composing import dotted
from xrgs.config import Conf
from xrgs.errors import XrgsError
from xrgs.runtime.machine import usable_cores
from xrgs.runtime.progress import log_line
from xrgs.safeio.hashing import file_digest
from xrgs.safeio.sanitize import for_line
from xrgs.splat.backend import resolve_backend
from xrgs.store import provenance
from xrgs.store.attempts import begin_attempt, free_name, plan_cell
from xrgs.store.cell_folder import CONFIG, HISTORY, IDENTITY, SPLATS, STATUS, CellFolder
from xrgs.store.identity import cell_identity
from xrgs.store.schema import Identity
from xrgs.store.store import Store
from xrgs.sweep import build_variants, job
from xrgs.sweep.axes import CellSpec
from xrgs.sweep.estimate import Cost
from xrgs.sweep.monitor import SweepMonitor
from xrgs.sweep.plan import PlannedCell

#: Files of results that are compared byte for byte.
_RESULTS = ("scores.csv", HISTORY, SPLATS)
#: Figures of the summary that are compared; times and memory differ from run to run.
_COUNTS = ("steps", "gaussians", "evaluations", "grow_grad2d")
#: Entries of the provenance that are not compared, or are compared otherwise.
_NOT_COMPARED = {"started", "arithmetic", "machines_in_turn"}
#: A value that differs is cut to this many characters.
_MAX_VALUE = 60


@dataclass(frozen=True)
class RerunResult:
    """The comparison of a cell with the same cell trained again."""

    folder: CellFolder
    before: list[str]
    """Differences of code, libraries and machine, known before the training."""
    differences: list[str]
    """Differences of the results; none if they are equal bit for bit."""

    def __str__(self) -> str:
        if self.differences:
            lines = ["The numbers are not the same."]
            lines += _listed(self.before, "differences in code, libraries or machine")
            lines += _listed(self.differences, "differences in the results")
        else:
            lines = [f"the same, bit for bit: {', '.join(_RESULTS)}, {', '.join(_COUNTS)}"]
            lines += _listed(self.before, "although these differ")
        return "\n".join(map(for_line, [*lines, f"Written to {self.folder.path}"]))


def rerun(
    folder: Path,
    out: Path | None = None,
    store: Path | None = None,
    threads: int | None = None,
    photographs: str | None = None,
    plugins: Sequence[str] = (),
) -> RerunResult:
    """Train a finished cell again and compare the results.

    The arguments are those of `xrgs-sweep rerun=` (`xrgs.cli.sweep.RerunConf`). A cell that needs a
    component of another package that is not among `plugins` is refused: a store must not decide
    which code is imported.

    Raises:
        XrgsError: The folder has no finished cell, or a config with unknown keys; the variant is
            missing and can't be built again; or the training failed.
    """
    original = CellFolder(folder)
    try:
        conf, added = _read(original)
        _check_plugins_allowed(original, conf, plugins)
        cells = folder.absolute().parent  # not resolved: `cells` may be a link to another disk
        if store is None and cells.name != "cells":
            raise XrgsError(
                f"rerun={folder} is not in a store; name the store that has its variant with"
                " store=..."
            )
        home = Store(store or cells.parent)
        conf.threads = original.provenance().threads if threads is None else threads
        conf.scene.path = photographs or conf.scene.path
        if conf.threads < 0:
            raise XrgsError(f"threads={conf.threads}: must be at least 0")
        repeated = CellFolder(_free_folder(out, folder))
        conf.splat.backend = resolve_backend(conf.splat.backend)
        variant_id = original.identity().variant
        identity = cell_identity(conf, variant_id)
        before = [*_differences_before(original, conf, added, identity)]
        title = "differences from when the cell was trained"
        for line in _listed(before, title) or ["code, libraries and machine are the same"]:
            log_line(line)
        _provide(variant_id, conf, home)
        _train_again(conf, home.variants / variant_id, repeated, identity, original)
        return RerunResult(repeated, before, [*_differences(original, repeated)])
    except OSError as error:
        raise XrgsError(f"rerun={folder}: {error}") from error


def _read(original: CellFolder) -> tuple[Conf, dict[str, Any]]:
    """Return the config of a finished cell, and the keys that are newer than it."""
    if not original.path.is_dir():
        raise XrgsError(f"rerun={original.path}: there is no such folder")
    for name in (CONFIG, IDENTITY, "provenance.json", STATUS):
        if not (original.path / name).is_file():
            raise XrgsError(f"rerun={original.path} is not a finished cell: it has no {name}")
    state = original.state()
    if state.name == "failed":
        reason = state.reason.partition("\n")[0]
        raise XrgsError(f"rerun={original.path}: the cell failed and has no results ({reason})")
    return composing.from_file(original.path / CONFIG)


def _check_plugins_allowed(original: CellFolder, conf: Conf, allowed: Sequence[str]) -> None:
    """Refuse a cell with a plugin that the user has not named; the message says what to add."""
    names = set(conf.components.plugins)
    if not names <= set(allowed):
        text = ",".join(sorted(names))
        raise XrgsError(
            f"rerun={original.path}: this cell was trained with components of other packages, whose"
            " code would be imported. If you trust the packages that are installed here under these"
            f" names, and the settings in the cell's config.json, add plugins={text}"
        )


def _differences_before(
    original: CellFolder, conf: Conf, added: Mapping[str, Any], now: Identity
) -> Iterator[str]:
    """Yield differences of the config's keys, the files, the program, libraries and machine."""
    if added:
        values = ", ".join(f"{key}={value}" for key, value in added.items())
        yield f"config.json lacks newer keys; their values in the baseline are taken: {values}"
    state, then = original.state(), original.identity()
    if state.name != "done":
        yield f"the folder: {state.name}: {state.reason}"
    if then.arithmetic != now.arithmetic:
        change = f"{then.arithmetic} -> {now.arithmetic}"
        yield f"arithmetic, which decides the last digits: {change}"
    for part in sorted(then.code.keys() | now.code.keys()):
        if then.code.get(part) != now.code.get(part):
            yield f"code: {part}: {then.code.get(part)} -> {now.code.get(part)}"
    here = provenance.collect(conf.threads or usable_cores(), conf.splat.backend)
    made, made_now = (
        dict(dotted(msgspec.to_builtins(one))) for one in (original.provenance(), here)
    )
    for name in sorted((made.keys() | made_now.keys()) - _NOT_COMPARED):
        if made.get(name) != made_now.get(name):
            before, after = (for_line(str(of.get(name)), _MAX_VALUE) for of in (made, made_now))
            yield f"{name}: {before} -> {after}"


def _provide(variant_id: str, conf: Conf, store: Store) -> None:
    """Make sure that the variant is in the store; build it, or make its images, again."""
    job.restore_images(conf, store, variant_id)
    if (store.variants / variant_id).is_dir():
        return
    log_line(f"variant {variant_id} is not in {store.path} and is built again")
    store.prepare()
    try:
        built = build_variants.build(conf, store)
    except XrgsError as error:
        raise XrgsError(f"variant {variant_id} is not in {store.path}, and: {error}") from error
    if built == variant_id:
        return
    same_key = built.partition("-")[0] == variant_id.partition("-")[0]
    why = (
        "the photographs are the same, but COLMAP gives other camera poses on this machine"
        if same_key
        else "its photographs, or the code that builds it, are not the same"
    )
    raise XrgsError(
        f"variant {variant_id} is not in {store.path}, and building it gave {built}: {why}. "
        "Name the store that has the variant with store=..."
    )


def _free_folder(out: Path | None, folder: Path) -> Path:
    """Return the folder to write to, which does not exist, in one that does."""
    if out is None:
        return free_name(folder.absolute(), "rerun")
    if out.exists():
        raise XrgsError(f"out={out} exists already")
    out.absolute().parent.mkdir(parents=True, exist_ok=True)
    return out.absolute()


def _train_again(
    conf: Conf, variant: Path, repeated: CellFolder, identity: Identity, original: CellFolder
) -> None:
    """Train like a sweep's cell, but without a lease: no other process writes to the folder."""
    plan_cell(repeated, conf, identity)
    begin_attempt(repeated)
    cell = PlannedCell(
        CellSpec("rerun", "", (), ()),
        conf,
        variant.name,
        identity,
        repeated.id,
        cost=Cost(original.summary().training_time_s, 0.0, 0.0, 0.0),
    )
    try:
        with SweepMonitor(repeated.path.parent) as monitor:
            monitor.watch([cell])
            job.run_in_child("cell", job.cell_request(variant, repeated))
    except XrgsError as error:
        repeated.fail(str(error))
        raise XrgsError(f"{error} ({repeated.path / 'log.txt'})") from error


def _differences(original: CellFolder, repeated: CellFolder) -> Iterator[str]:
    """Yield the differences of two cells' results, scores first."""
    yield from _score_differences(original, repeated)
    for name in _COUNTS:
        values = [getattr(cell.summary(), name) for cell in (original, repeated)]
        if values[0] != values[1]:
            shown = [f"{value:,}" if isinstance(value, int) else str(value) for value in values]
            yield f"{name}: {' -> '.join(shown)}"
    trimmed = original.status().trimmed
    for name in _RESULTS:
        if name not in trimmed and not (original.path / name).is_file():
            yield f"{name}: missing in {original.path}"
            continue
        then = trimmed[name].sha256 if name in trimmed else file_digest(original.path / name)
        if then != file_digest(repeated.path / name):
            yield f"{name}: the bytes differ"


def _score_differences(original: CellFolder, repeated: CellFolder) -> Iterator[str]:
    """Yield for each metric by how much the scores of two cells differ."""
    then, now = _scores(original), _scores(repeated)
    if then.keys() != now.keys():
        views = sorted({view for view, _ in then.keys() ^ now.keys()})
        yield f"scores.csv: only one of the two has {', '.join(views)}"
    differences_of: dict[str, list[float]] = {}
    for view, metric in then.keys() & now.keys():
        a, b = then[view, metric], now[view, metric]
        if a != b and not (math.isnan(a) and math.isnan(b)):
            differences_of.setdefault(metric, []).append(abs(a - b))
    for metric, differences in sorted(differences_of.items()):
        numbers = [difference for difference in differences if not math.isnan(difference)]
        amount = f"by at most {max(numbers):.3g}" if numbers else "and one of the two has no score"
        yield f"{metric}: differs in {len(differences)} views, {amount}"


def _scores(cell: CellFolder) -> dict[tuple[str, str], float]:
    """Return the scores by view and metric, NaN where one is missing."""
    return {(view, name): value for view, row in cell.view_scores() for name, value in row.items()}


def _listed(lines: list[str], title: str) -> list[str]:
    return [f"{title}:", *(f"  {line}" for line in lines)] if lines else []
