"""Describes one cell of a store: what it is, how it differs from its baseline, and what it gave."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import msgspec

from xrgs.errors import StoreError
from xrgs.evaluation.metrics import METRICS
from xrgs.experiment.results import cell_columns, cell_metrics
from xrgs.safeio.files import walk_files
from xrgs.safeio.sanitize import MAX_CELL, for_line
from xrgs.sweep.inventory import age_text, size_text

if TYPE_CHECKING:
    from collections.abc import Iterator

    from xrgs.experiment.cell_folder import CellFolder
    from xrgs.experiment.store import Store
    from xrgs.sweep.inventory import CellSummary

#: Entries of a cell's provenance that are shown, the others are in `provenance.json`.
_PROVENANCE = (
    *("started", "xrgs", "git", "git_diff_sha256", "backend", "threads", "cpu", "platform"),
    "machines_in_turn",
)
#: Columns of a cell's config that say where it is, and not what it is.
_NAMES = frozenset({"cell_id", "scene", "label", "condition", "variant"})


def show(store: Store, cell: CellSummary) -> str:
    """Return the description of a cell, several lines for a terminal.

    Args:
        store: The store.
        cell: The cell.
    """
    sections = {
        "": _head(cell),
        _difference_title(cell): _differences(store, cell),
        "scores (means over the scored views)": _scores(cell.folder),
        "made with": _provenance(cell.folder),
        "files": _files(cell.folder),
    }
    lines: list[str] = []
    for title, found in sections.items():
        body = list(found)
        if body:
            lines += [f"{title}:", *(f"  {line}" for line in body)] if title else body
    return "\n".join(for_line(line) for line in lines)


def _head(cell: CellSummary) -> Iterator[str]:
    reason = f": {cell.state.reason.partition(chr(10))[0]}" if cell.state.reason else ""
    yield f"cell {cell.name} / seed {cell.seed}"
    yield f"  {cell.state.name}{reason}, {age_text(cell.age_s())} ago, {size_text(cell.bytes())}"
    yield f"  variant {cell.variant_id}"
    yield f"  sweeps {', '.join(reversed(cell.names.sweeps)) or 'none'}"
    if cell.stale:
        yield f"  trained with another program than is installed: {', '.join(cell.stale)}"


def _difference_title(cell: CellSummary) -> str:
    return f"differs from its baseline {cell.names.baseline_id} in"


def _differences(store: Store, cell: CellSummary) -> Iterator[str]:
    """Yield the values of the config in which a cell differs from the baseline of its pair."""
    base_id = cell.names.baseline_id
    if base_id is None:
        yield "(no sweep names a baseline for it)"
        return
    if base_id == cell.id:
        yield "nothing: it is the baseline"
        return
    base = store.cell(base_id)
    if not (base.path / "config.json").exists():
        yield "(its baseline is not in this store)"
        return
    then, now = (cell_columns(folder, None) for folder in (base, cell.folder))
    for key in sorted((then.keys() | now.keys()) - _NAMES):
        if then.get(key) != now.get(key):
            yield f"{key}: {_short(then.get(key))} -> {_short(now.get(key))}"


def _short(value: Any) -> str:
    return for_line(str(value), MAX_CELL)


def _scores(folder: CellFolder) -> Iterator[str]:
    try:
        metrics = cell_metrics(folder.summary(), folder.scores())
    except (StoreError, OSError):
        return  # a cell that is not done has none, and its state says why
    for metric in METRICS:
        if metric.name in metrics:
            yield f"{metric.name}: {metrics[metric.name]:,.6g} {metric.unit}".rstrip()


def _provenance(folder: CellFolder) -> Iterator[str]:
    try:
        found = msgspec.structs.asdict(folder.provenance())
    except StoreError:
        return
    yield from (f"{key}: {_short(found[key])}" for key in _PROVENANCE if found[key])


def _files(folder: CellFolder) -> Iterator[str]:
    try:
        files = sorted(walk_files(folder.path))
    except OSError as error:
        yield f"{error.filename}: {error.strerror}"
        return
    renders = [status.st_size for name, status in files if name.startswith("renders/")]
    for name, status in files:
        if not name.startswith("renders/"):
            yield f"{name}  {size_text(status.st_size)}"
    if renders:
        yield f"renders/  {len(renders)} files, {size_text(sum(renders))}"
    if folder.is_trimmed():
        trimmed = folder.status().trimmed
        yield f"removed by xrgs-store trim: {len(trimmed)} files (Gaussians and renders)"
