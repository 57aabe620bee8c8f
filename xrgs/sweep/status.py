"""Texts of the commands that summarise a store, list its cells and sweeps, or show one cell."""

from __future__ import annotations

import math
import shlex
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import TypeVar

import msgspec

from xrgs.errors import StoreError
from xrgs.evaluation.metrics import METRICS
from xrgs.mixture.paths import TO_TRY, failed_scenes, is_variant
from xrgs.runtime import lease, progress
from xrgs.runtime.streams import is_terminal, redraw, say
from xrgs.runtime.text import TextTable, format_age, format_size, listed, to_text
from xrgs.safeio.files import file_bytes, is_name, walk_files
from xrgs.safeio.records import list_folder
from xrgs.safeio.sanitize import MAX_CELL, counted, for_file_name, for_line
from xrgs.store.cell_folder import CellFolder
from xrgs.store.listing import STATES, CellRow, SweepRow, latest_records
from xrgs.store.store import DEFAULT_STORE, Store
from xrgs.sweep.monitor import PAUSE_FACTOR
from xrgs.sweep.plan import PlannedCell

_T = TypeVar("_T")
#: The most cells, scenes or problems that are listed by name under one heading.
_MAX_NAMED = 20
#: The most cells that are listed with their ids at the end of a run, and the number of characters
#: of an id in a command.
_MAX_DONE, _ID = 12, 8
#: Least seconds between two looks of `watch` on a terminal, and seconds between two in a log.
_WATCH_S, _LOG_S = 2.0, 60.0
#: Entries of a cell's provenance that are shown; the others are in `provenance.json`.
_PROVENANCE = (
    *("started", "xrgs", "git", "git_diff_sha256", "backend", "threads", "cpu", "platform"),
    *("gpu", "machines_in_turn"),
)
#: Columns that name a cell. All others hold its settings.
_NAMES = frozenset({"cell_id", "scene", "label", "condition", "variant"})


# A store


class _Problems(list[str]):
    """Lines that name files and folders that can't be read, or that don't belong in a store."""

    def note_error(self, look: Callable[[], _T]) -> _T | None:
        """Return the result of a function; if it can't read a file, add a line and return None."""
        try:
            return look()
        except StoreError as error:
            self.append(str(error))
        except OSError as error:
            self.append(f"{error.filename}: {error.strerror}")
        return None


def describe(path: Path) -> str:
    """Return the state of a store as text, and write nothing.

    The cells' files are checked by their sizes only. A file that can't be read is named among the
    problems, and does not hide the rest.

    Raises:
        StoreError: There is no such store, or it can't be read now.
    """
    store, problems = Store(path), _Problems()
    store.check_exists()
    records, damaged = problems.note_error(store.records) or ({}, ())
    problems += damaged
    cells = problems.note_error(partial(store.cell_rows, records)) or []
    counts = Counter(cell.state.name for cell in cells)
    parts = [f"{counts[state]} {state}" for state in STATES if counts[state]]
    lines = [f"store {path}: {counted(len(cells), 'cell')}", f"  {', '.join(parts) or 'none'}"]
    names = problems.note_error(partial(list_folder, store.cells_folder)) or []
    wrong = [name for name in names if not is_name(name)]
    problems += [f"{store.cells_folder}/{name}: a cell can't have this name" for name in wrong]
    if aside := sum("." in name and is_name(name) for name in names):
        lines.append(f"  {counted(aside, 'folder')} of earlier attempts and reruns (*.*)")
    names = problems.note_error(partial(list_folder, store.variants)) or []
    variants = {name: (store.variants / name).is_dir() for name in names if is_variant(name)}
    problems += [
        f"{store.variants}/{name}: not a folder" for name, of in variants.items() if not of
    ]
    sweeps = counted(len(records) + len(damaged), "sweep")
    lines.append(f"  {counted(sum(variants.values()), 'variant')}, {sweeps} recorded")
    scenes = problems.note_error(partial(failed_scenes, store.variants)) if names else None
    sizes = {
        name: problems.note_error(partial(file_bytes, path / name))
        for name in problems.note_error(partial(list_folder, path)) or []
        if (path / name).is_dir()
    }
    at_least = " at least" * (None in sizes.values())
    texts = [f"{name} {format_size(size)}" for name, size in sorted(sizes.items())]
    total = format_size(sum(size or 0 for size in sizes.values()))
    lines += [f"  {total} on disk{at_least}: {', '.join(texts)}", *_table(cells)]
    done = sorted((c for c in cells if c.state.name == "done"), key=lambda c: c.age_s or 0)
    lines += _named("done, the latest first:", [cell.name for cell in done], "xrgs-store list")
    for state in ("running", "failed", "corrupt", "unfinished"):
        of_state = [cell for cell in cells if cell.state.name == state]
        lines += _named(f"{state}:", [_reason(cell) for cell in of_state])
    failed = ["  ".join((key, *why)) for key, why in (scenes or {}).items()]
    lines += _named("failed scenes, not tried again; retry=failed tries them again", failed)
    lines += TO_TRY if failed else ()
    changed = Counter(part for cell in cells for part in cell.stale)
    stale = counted(sum(bool(cell.stale) for cell in cells), "done cell")
    title = f"stale: {stale} of other code or arithmetic than here"
    lines += _named(title, [f"{part}: {counted(n, 'cell')}" for part, n in changed.most_common()])
    lines += _named("can't be read, or does not belong there:", problems)
    return "\n".join(map(for_line, lines))


def _table(cells: Sequence[CellRow]) -> list[str]:
    """Return a table of the cells of each scene and label by state, without empty columns."""
    if not cells:
        return []
    counts: dict[tuple[str, str], Counter[str]] = {}
    for cell in cells:
        row = counts.setdefault((cell.scene, cell.arm), Counter())
        row[cell.state.name] += 1
        row["stale"] += bool(cell.stale)
    columns = [c for c in (*STATES, "stale") if any(row[c] for row in counts.values())]
    rows = [(*key, *(str(row[c] or "") for c in columns)) for key, row in sorted(counts.items())]
    heads, align = ("scene", "label", *columns), "ll" + "r" * len(columns)
    return to_text(TextTable("", heads, tuple(rows), align)).rstrip().split("\n")


def _reason(cell: CellRow) -> str:
    # The latest of the sweeps that have a running cell is the one that trains it now.
    sweep = f"  sweep {cell.sweeps[-1]}" if cell.state.name == "running" and cell.sweeps else ""
    return f"{cell.name}{sweep}  {cell.state.reason.partition(chr(10))[0]}"


def _named(heading: str, names: Sequence[str], command: str = "") -> list[str]:
    """Return a heading with the first names below it; `command` lists all of them."""
    if not names:
        return []
    left = len(names) - _MAX_NAMED
    more = [f"  and {left} more{command and f': {command} has all'}"] if left > 0 else []
    return ["", heading, *(f"  {name}" for name in names[:_MAX_NAMED]), *more]


def watch(path: Path) -> None:
    """Show the cells in training until Ctrl-C, on a terminal in place; raises as `read`."""
    store, drawn, pause = Store(path), 0, _WATCH_S
    store.check_exists()
    with suppress(KeyboardInterrupt):
        while True:
            start = time.monotonic()
            text = running(store)
            if is_terminal(sys.stdout):
                drawn = redraw(text, drawn, sys.stdout)
                pause = max(_WATCH_S, PAUSE_FACTOR * (time.monotonic() - start))
            else:
                say(text)
                pause = _LOG_S
            time.sleep(pause)


def running(store: Store) -> str:
    """Return lines for `watch`: the time, the running sweeps, and the progress of their cells."""
    records, _ = store.records()
    training = {
        cell_id: now
        for cell_id in lease.holders(store.leases)
        if (now := progress.read(store.cell(cell_id).progress))
    }
    lines = [f"{time.strftime('%H:%M:%S')}  {counted(len(training), 'cell')} in training"]
    # A cell of several sweeps is trained by the latest one.
    sweeps = {row.cell_id: name for name, record in records.items() for row in record.cells}
    for name in sorted({sweeps[cell_id] for cell_id in training if cell_id in sweeps}):
        rows = records[name].cells
        ids = {row.cell_id for row in rows if row.cell_id}
        done = sum(store.cell(cell_id).state(verify=False).name == "done" for cell_id in ids)
        lines.append(f"sweep {name}: {done} of {counted(len(rows), 'cell')} done")
    names = latest_records(records)
    for cell_id, now in sorted(training.items()):
        parts: tuple[str, ...] = (cell_id,)  # its name where no sweep has it
        if row := names.get(cell_id):
            replicate = f"replicate {row.variant_seed}/{row.seed}"
            parts = (row.scene, row.label, row.condition, replicate)
        lines.append(f"  {' / '.join(filter(None, parts))}: {now}")
    return "\n".join(map(for_line, lines))


# Lists


def list_cells(cells: Sequence[CellRow], sort: str) -> str:
    """Return cells as a table, by `name`, `age` (the oldest last) or `size` (the largest last)."""
    if sort != "name":
        cells = sorted(cells, key=lambda row: (row.age_s if sort == "age" else row.bytes) or 0)
    rows = []
    for row in cells:
        code = "code not installed" if row.of_elsewhere else "old code"
        marks = ["trimmed"] * row.folder.is_trimmed() + [code] * bool(row.stale)
        state = row.state.name + (f" ({', '.join(marks)})" if marks else "")
        names = (row.id, row.scene, row.arm, str(row.seed), state)
        rows.append((*names, format_age(row.age_s), format_size(row.bytes)))
    total = format_size(sum(row.bytes or 0 for row in cells))
    columns = ("cell", "scene", "ablation", "seed", "state", "age", "size")
    title = f"{counted(len(rows), 'cell')}, {total}"
    return to_text(TextTable(title, columns, tuple(rows), "lllrlrr")).rstrip()


def list_sweeps(sweeps: Sequence[SweepRow]) -> str:
    """Return recorded sweeps as a table for a terminal."""
    rows = []
    for row in sweeps:
        recorded, when = row.record.cells, "?"
        if row.recorded_at:
            local = datetime.fromtimestamp(row.recorded_at, UTC).astimezone()
            when = local.strftime("%Y-%m-%d %H:%M")
        scenes, labels = (
            listed(list(dict.fromkeys(names)))
            for names in ((cell.scene for cell in recorded), (cell.label for cell in recorded))
        )
        done = f"{row.states['done']} of {len(recorded)} done"
        others = sorted(row.states.keys() - {"done"}, key=lambda name: (name == "pending", name))
        counts = ", ".join([done, *(f"{row.states[name]} {name}" for name in others)])
        rows.append((row.id, when, scenes, labels, counts))
    columns = ("sweep", "recorded", "scenes", "labels", "cells")
    return to_text(TextTable(counted(len(rows), "sweep"), columns, tuple(rows), "lllll")).rstrip()


# One cell


def show(store: Store, cell: CellRow) -> str:
    """Describe one cell: its state, its differences from the baseline, scores and files."""
    base_id = cell.recorded.baseline_id if cell.recorded else None
    base = f"its baseline {base_id}" if base_id else "its baseline"
    sections = {
        "": _head(cell),
        f"differs from {base} in": _differences(store, cell, base_id),
        "scores (means over the scored views)": _scores(cell.folder),
        "made with": _provenance(cell.folder),
        "files": _files(cell.folder),
    }
    lines: list[str] = []
    for title, section in sections.items():
        body = list(section)
        if body:
            lines += [f"{title}:", *(f"  {line}" for line in body)] if title else body
    return "\n".join(for_line(line) for line in lines)


def _head(cell: CellRow) -> Iterator[str]:
    reason = f": {cell.state.reason.partition(chr(10))[0]}" if cell.state.reason else ""
    yield f"cell {cell.name}"
    yield f"  {cell.state.name}{reason}, {format_age(cell.age_s)} ago, {format_size(cell.bytes)}"
    yield f"  variant {cell.variant_id}"
    yield f"  sweeps {', '.join(reversed(cell.sweeps)) or 'none'}"
    if cell.stale:
        yield f"  trained with another program than is installed: {', '.join(cell.stale)}"


def _differences(store: Store, cell: CellRow, base_id: str | None) -> Iterator[str]:
    if base_id is None:
        yield "(no sweep names a baseline for it)"
        return
    if base_id == cell.id:
        yield "nothing: it is the baseline"
        return
    base = store.cell(base_id)
    if base.state(verify=False).name == "absent":
        yield "(its baseline is not in this store)"
        return
    from xrgs.store.results import cell_columns  # pandas is slow to load

    then, now = (cell_columns(folder, None) for folder in (base, cell.folder))
    for key in sorted((then.keys() | now.keys()) - _NAMES):
        if then.get(key) != now.get(key):
            yield f"{key}: {_short(then.get(key))} -> {_short(now.get(key))}"


def _short(value: object) -> str:
    return for_line(str(value), MAX_CELL)


def _scores(folder: CellFolder) -> Iterator[str]:
    from xrgs.store.results import cell_metrics  # pandas is slow to load

    try:
        metrics = cell_metrics(folder.summary(), folder.scores())
    except (StoreError, OSError):
        return  # a cell that is not done has none, and its state says why
    for metric in METRICS:
        value = metrics.get(metric.name, math.nan)
        if not math.isnan(value):  # no view was scored by it
            yield f"{metric.name}: {value:,.6g} {metric.unit}".rstrip()


def _provenance(folder: CellFolder) -> Iterator[str]:
    try:
        provenance = msgspec.structs.asdict(folder.provenance())
    except StoreError:
        return
    yield from (f"{key}: {_short(provenance[key])}" for key in _PROVENANCE if provenance[key])


def _files(folder: CellFolder) -> Iterator[str]:
    try:
        files = sorted(walk_files(folder.path))
    except OSError as error:
        yield f"{error.filename}: {error.strerror}"
        return
    renders = [status.st_size for name, status in files if name.startswith("renders/")]
    for name, status in files:
        if not name.startswith("renders/"):
            yield f"{name}  {format_size(status.st_size)}"
    if renders:
        yield f"renders/  {len(renders)} files, {format_size(sum(renders))}"
    if folder.is_trimmed():
        trimmed = folder.status().trimmed
        yield f"removed by xrgs-store trim: {len(trimmed)} files (Gaussians and renders)"


# The end of a run


def ending(plan: Sequence[PlannedCell], store: Path) -> str:
    """Return the text after a sweep's report: the ids of its done cells, and commands to go on."""
    done = [cell for cell in plan if cell.cell_id and cell.state.name == "done"]
    if not done:
        return ""
    rows = tuple((str(cell.cell_id), cell.name) for cell in done[:_MAX_DONE])
    more = len(done) - _MAX_DONE
    notes = (f"and {more} more: xrgs-status lists them",) if more > 0 else ()
    table = TextTable(counted(len(done), "done cell"), ("cell", "name"), rows, "ll", notes)
    last = done[-1]
    # Its baseline, where the two share a variant: no camera shows the same in two variants.
    alike = (last.spec.shared, last.variant_id)
    first = next(cell for cell in done if (cell.spec.shared, cell.variant_id) == alike)
    shown = list(dict.fromkeys(str(cell.cell_id)[:_ID] for cell in (first, last)))
    commands = next_commands(shown, last.spec.label, store)
    return "\n".join([to_text(table), "Next:", *(f"  {line}" for line in commands)])


def next_commands(cells: Sequence[str], name: str, store: Path) -> list[str]:
    """Return the commands that show trained cells, make a film of them, and export the last.

    The cells are one, or two of one variant, as a command takes them. The files that are written
    get the name, and a suffix.
    """
    words = shlex.join(cells)
    where = "" if store == DEFAULT_STORE else f" --store {shlex.quote(str(store))}"
    file = shlex.quote(for_file_name(name))
    return [
        f"xrgs-view {words}{where}",
        f"xrgs-render {words} --out {file}.mp4{where}",
        f"xrgs-data export {shlex.quote(cells[-1])} --out {file}.ply{where}",
    ]
