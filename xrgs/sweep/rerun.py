"""A cell trained again from its folder alone: the same numbers, or what differs.

Its config says what to train, its variant what on. What differs before it is trained (the program,
its libraries, the machine) is said first; it is why numbers differ, if they do.
"""

from __future__ import annotations

import math
import re
from dataclasses import asdict, dataclass
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Any

from xrgs import config
from xrgs.errors import XrgsError
from xrgs.experiment import provenance
from xrgs.experiment.identity import cell_identity
from xrgs.experiment.store import CellFolder, Store
from xrgs.runtime.machine import usable_cores
from xrgs.runtime.progress import say
from xrgs.safeio.hashing import digest, file_digest
from xrgs.safeio.records import StoreError
from xrgs.safeio.untrusted import printable
from xrgs.splat.backend import resolve_backend
from xrgs.sweep.jobs import worker
from xrgs.sweep.monitor import View
from xrgs.sweep.plan import CellSpec, Planned

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from xrgs.config import Conf

#: Compared byte for byte.
_RESULTS = ("scores.csv", "history.csv", "splats.ply")
#: Of the summary: what no clock and no other process has a part in.
_COUNTS = ("steps", "gaussians", "evaluations", "grow_grad2d")
_ID = re.compile(r"[0-9a-f]{16}")
_VARIANT = re.compile(rf"{_ID.pattern}-{_ID.pattern}")


@dataclass(frozen=True)
class RerunResult:
    """A cell that was trained again."""

    folder: CellFolder
    before: list[str]
    """What differed before it was trained."""
    differences: list[str]
    """In what it gave. Empty: the same, bit for bit."""

    def __str__(self) -> str:
        if self.differences:
            lines = ["not the same numbers", *_listed(self.before, "what differs in how")]
            lines += _listed(self.differences, "what differs in what it gave")
        else:
            lines = [f"the same, bit for bit: {', '.join(_RESULTS)}, {', '.join(_COUNTS)}"]
            lines += _listed(self.before, "although these differ")
        return "\n".join([*lines, f"Written to {self.folder.path}"])


def rerun(
    folder: Path,
    out: Path | None = None,
    store: Path | None = None,
    threads: int | None = None,
    photographs: str | None = None,
) -> RerunResult:
    """Train a finished cell again and compare.

    Args:
        folder: the cell's, in a store or not.
        out: where to; `<folder>.rerun-1` (or the next number) where none is given.
        store: where its variant lies, or is built; the store that the folder is in, where none is
            given. Its config names one too, but may be a stranger's.
        threads: in place of as many as it was trained with. No number is meant to depend on them.
        photographs: in place of the config's `scene.path`, where the variant has to be built.

    Raises:
        XrgsError: the folder holds no finished cell, or the config of another version; there is no
            such variant and it can't be made again; or the training failed.
    """
    original = CellFolder(folder)
    conf, identity = _read(original)
    home = Store(store or _store_of(folder))
    conf.threads = conf.threads if threads is None else threads
    conf.scene.path = photographs or conf.scene.path
    if conf.threads < 0:
        raise XrgsError(f"threads={conf.threads}: must be at least 0")
    if out is not None and out.exists():
        raise XrgsError(f"out={out}: is there already")
    conf.splat.backend = resolve_backend(conf.splat.backend)
    now = cell_identity(conf, str(identity["variant"]))
    before = [*_own_contradictions(original, identity, now), *_other_program(original, conf, now)]
    for line in _listed(before, "what differs from when it was trained") or ["nothing differs yet"]:
        say(line)
    _provide(str(identity["variant"]), conf, home)
    again = CellFolder(out or _next_to(folder))
    _train(conf, home.variants / str(identity["variant"]), again, now, original)
    return RerunResult(again, before, [*_differences(original, again)])


def _read(original: CellFolder) -> tuple[Conf, dict[str, Any]]:
    """Its config, with as many threads as it was trained with, and its identity."""
    if not original.path.is_dir():
        raise XrgsError(f"rerun={original.path}: no such folder")
    for name in ("config.json", "identity.json", "provenance.json", "status.json"):
        if not (original.path / name).is_file():
            raise XrgsError(f"rerun={original.path}: not the folder of a finished cell: no {name}")
    state = original.state()
    if state.name == "failed":
        reason = state.reason.partition("\n")[0]
        raise XrgsError(f"rerun={original.path}: failed, so that it has no numbers ({reason})")
    conf = config.from_file(original.path / "config.json")
    try:
        identity, conf.threads = original.identity(), int(original.provenance()["threads"])
    except (KeyError, TypeError, ValueError) as error:
        raise XrgsError(f"{original.path}: identity.json or provenance.json: {error!r}") from error
    if not _VARIANT.fullmatch(str(identity.get("variant"))):
        raise XrgsError(f"{original.path / 'identity.json'}: variant={identity.get('variant')}")
    return conf, identity


def _own_contradictions(
    original: CellFolder, then: Mapping[str, Any], now: Mapping[str, Any]
) -> Iterator[str]:
    """What the folder's own files have against each other: somebody has changed them."""
    state = original.state()
    if state.name != "done":
        yield f"the folder: {state.name}: {state.reason}"
    named = original.id.partition(".")[0]
    if _ID.fullmatch(named) and digest(then) != named:
        yield f"the folder: identity.json is of cell {digest(then)}, not of {named}"
    known = {"code", "protocol", "variant"}  # the rest is from config.json
    for line in _changes(_without(then, known), _without(now, known)):
        yield f"identity.json against config.json: {line}"


def _other_program(original: CellFolder, conf: Conf, now: Mapping[str, Any]) -> Iterator[str]:
    """What is another program, library or machine than then."""
    then = original.identity()
    if then.get("protocol") != now["protocol"]:
        yield f"protocol of evaluation: {then.get('protocol')} -> {now['protocol']}"
    code = then.get("code") or {}
    for file in sorted(code.keys() | now["code"].keys()):
        if code.get(file) != now["code"].get(file):
            what = "new" if file not in code else "changed" if file in now["code"] else "gone"
            yield f"code: {file} ({what})"
    here = provenance.collect(conf.threads or usable_cores(), conf.splat.backend)
    made_with = original.provenance()
    new = here.keys() - made_with.keys()  # that an older version did not record
    yield from _changes(_without(made_with, {"started"}), _without(here, {"started", *new}))


def _without(values: Mapping[str, Any], names: set[str]) -> dict[str, Any]:
    return {name: value for name, value in values.items() if name not in names}


def _changes(then: Any, now: Any, path: str = "") -> Iterator[str]:
    if not isinstance(then, dict) or not isinstance(now, dict):
        if then != now:
            yield f"{path}: {_short(then)} -> {_short(now)}"
        return
    for name in sorted(then.keys() | now.keys()):
        yield from _changes(then.get(name), now.get(name), f"{path}.{name}" if path else name)


def _short(value: object) -> str:
    text = printable(str(value))
    return text if len(text) < 60 else f"{text[:16]}..."


def _store_of(folder: Path) -> Path:
    cells = folder.resolve().parent
    if cells.name != "cells":
        raise XrgsError(f"rerun={folder}: not in a store: name one that has its variant, store=...")
    return cells.parent


def _provide(wanted: str, conf: Conf, store: Store) -> None:
    """See to it that the variant is in the store.

    Raises:
        XrgsError: it is not, and building it again gives another one.
    """
    if (store.variants / wanted).is_dir():
        return
    say(f"variant {wanted} is not in {store.path}: building it from {conf.scene.path or 'scratch'}")
    store.prepare()
    try:
        made = worker.run("variant", {"conf": asdict(conf), "store": str(store.path)})["variant"]
    except XrgsError as error:
        raise XrgsError(f"variant {wanted} is not in {store.path}, and: {error}") from error
    if made == wanted:
        return
    alike = made.partition("-")[0] == wanted.partition("-")[0]
    why = (
        "the photographs are the same, but COLMAP places them otherwise each time"
        if alike
        else "its photographs, or the code that makes it, are others"
    )
    raise XrgsError(
        f"variant {wanted} is not in {store.path}, and was built as {made}: {why}. "
        "Give the store that has it, store=..."
    )


def _next_to(folder: Path) -> Path:
    folder = folder.resolve()
    names = (folder.with_name(f"{folder.name}.rerun-{number}") for number in count(1))
    return next(name for name in names if not name.exists())


def _train(
    conf: Conf, variant: Path, again: CellFolder, identity: dict[str, Any], original: CellFolder
) -> None:
    """Train as a sweep's cell is; nobody else knows of the folder, so there is no lock."""
    again.begin(asdict(conf), identity)
    plan = Planned(
        CellSpec("again", "", (), ()),
        conf,
        variant.name,
        again.id,
        seconds=_seconds(original),
    )
    try:
        with View(again.path.parent) as view:
            view.watch([plan])
            request = {"conf": asdict(conf), "variant": str(variant), "cell": str(again.path)}
            worker.run("cell", request)
    except XrgsError as error:
        again.fail(str(error))
        raise XrgsError(f"{error} ({again.path / 'log.txt'})") from error


def _seconds(original: CellFolder) -> float | None:
    try:
        return float(_summary(original)["training_time_s"])
    except (KeyError, TypeError, ValueError):
        return None


def _summary(cell: CellFolder) -> dict[str, Any]:
    try:
        return cell.summary()
    except (StoreError, TypeError, ValueError):
        return {}


def _differences(original: CellFolder, again: CellFolder) -> Iterator[str]:
    """What is not the same in what two cells gave, numbers first."""
    yield from _scores(original, again)
    summaries = _summary(original), _summary(again)
    for name in _COUNTS:
        then, now = (summary.get(name) for summary in summaries)
        if then != now:
            yield f"{name}: {_number(then)} -> {_number(now)}"
    for name in _RESULTS:
        then, now = original.path / name, again.path / name
        if not then.is_file():
            yield f"{name}: not in {original.path}"
        elif file_digest(then) != file_digest(now):
            yield f"{name}: other bytes"


def _scores(original: CellFolder, again: CellFolder) -> Iterator[str]:
    """Of each score: how far the two are apart."""
    then, now = _table(original), _table(again)
    if then.keys() != now.keys():
        views = sorted({view for view, _ in then.keys() ^ now.keys()})
        yield f"scores.csv: only one has {', '.join(views)}"
    apart: dict[str, list[float]] = {}
    for view, metric in then.keys() & now.keys():
        a, b = then[view, metric], now[view, metric]
        if a != b and not (math.isnan(a) and math.isnan(b)):
            apart.setdefault(metric, []).append(abs(a - b))
    for metric, differences in sorted(apart.items()):
        known = [difference for difference in differences if not math.isnan(difference)]
        how = f"by at most {max(known):.3g}" if known else "and one of the two has none"
        yield f"{metric}: differs in {len(differences)} views, {how}"


def _table(cell: CellFolder) -> dict[tuple[str, str], float]:
    """(view, metric) -> value, NaN where there is none; empty where it can't be read."""
    try:
        scores = cell.scores()
    except StoreError:
        return {}
    return {(view, name): value for view, row in scores for name, value in row.items()}


def _number(value: object) -> str:
    return f"{value:,}" if isinstance(value, int) else str(value)


def _listed(lines: list[str], title: str) -> list[str]:
    return [f"{title}:", *(f"  {line}" for line in lines)] if lines else []
