"""Texts of the commands that list a store: its cells, its sweeps, and one cell in full."""

from __future__ import annotations

import math
from datetime import UTC, datetime
from typing import TYPE_CHECKING

import msgspec

from xrgs.errors import StoreError, XrgsError
from xrgs.evaluation.metrics import METRICS
from xrgs.runtime.text import TextTable, format_age, format_size, to_text
from xrgs.safeio.files import walk_files
from xrgs.safeio.sanitize import MAX_CELL, counted, for_line
from xrgs.store.results import cell_columns, cell_metrics

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from xrgs.store.cell_folder import CellFolder
    from xrgs.store.listing import CellRow, SweepRow
    from xrgs.store.store import Store

#: The most names of scenes or labels that a line lists.
_MAX_LISTED = 6
#: Entries of a cell's provenance that are shown; the others are in `provenance.json`.
_PROVENANCE = (
    *("started", "xrgs", "git", "git_diff_sha256", "backend", "threads", "cpu", "platform"),
    *("gpu", "machines_in_turn"),
)
#: Columns that name a cell. All others hold its settings.
_NAMES = frozenset({"cell_id", "scene", "label", "condition", "variant"})


def list_cells(cells: Sequence[CellRow], sort: str) -> str:
    """Return cells as a table, by `name`, `age` (the oldest last) or `size` (the largest last)."""
    if sort not in {"name", "age", "size"}:
        raise XrgsError(f"sort={sort}: choose name, age or size")
    if sort != "name":
        cells = sorted(cells, key=lambda row: (row.age_s if sort == "age" else row.bytes) or 0)
    rows = []
    for row in cells:
        marks = ["trimmed"] * row.folder.is_trimmed() + ["old code"] * bool(row.stale)
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
        scenes = _distinct(cell.scene for cell in recorded)
        labels = _distinct(cell.label for cell in recorded)
        done = f"{row.states['done']} of {len(recorded)} done"
        others = sorted(row.states.keys() - {"done"}, key=lambda name: (name == "pending", name))
        counts = ", ".join([done, *(f"{row.states[name]} {name}" for name in others)])
        rows.append((row.id, when, scenes, labels, counts))
    columns = ("sweep", "recorded", "scenes", "labels", "cells")
    return to_text(TextTable(counted(len(rows), "sweep"), columns, tuple(rows), "lllll")).rstrip()


def _distinct(names: Iterable[str]) -> str:
    distinct = list(dict.fromkeys(names))
    more = len(distinct) - _MAX_LISTED
    return ", ".join(distinct[:_MAX_LISTED]) + (f" and {more} more" if more > 0 else "")


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
    yield f"cell {cell.name} / seed {cell.seed}"
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
    then, now = (cell_columns(folder, None) for folder in (base, cell.folder))
    for key in sorted((then.keys() | now.keys()) - _NAMES):
        if then.get(key) != now.get(key):
            yield f"{key}: {_short(then.get(key))} -> {_short(now.get(key))}"


def _short(value: object) -> str:
    return for_line(str(value), MAX_CELL)


def _scores(folder: CellFolder) -> Iterator[str]:
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
