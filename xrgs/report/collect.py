"""A sweep's cells, read from the store into tables: nothing is computed twice, nothing is trained.

Cells that are not done are kept as rows with their state and reason, so that a report shows them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from xrgs.errors import XrgsError
from xrgs.runtime.progress import progress
from xrgs.safeio.records import StoreError, as_number

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from xrgs.evaluation.metrics import Metric
    from xrgs.experiment.store import CellFolder, Store

#: What the rows of a sweep's record hold.
RECORD_KEYS = (
    "scene",
    "condition",
    "label",
    "seed",
    "cell_id",
    "variant_id",
    "baseline_id",
    "error",
)


class ReportError(XrgsError):
    """A sweep that can't be reported: its message names the cells or the file."""


@dataclass(frozen=True)
class Sweep:
    """What a store knows of one sweep."""

    id: str
    command: tuple[str, ...]
    cells: pd.DataFrame
    """One row an entry of the record: its keys, `state`, `reason`, `protocol` and every metric."""
    views: pd.DataFrame
    """One row a cell and test view: `cell_id`, `view` and the scores."""
    provenance: dict[str, list[str]]
    """What the done cells were made with: the distinct values of each entry, sorted."""


def read_sweep(store: Store, sweep_id: str, metrics: Sequence[Metric]) -> Sweep:
    """Read a sweep's record and every cell that it names.

    Args:
        store: the store that holds it.
        sweep_id: the sweep.
        metrics: those whose values are wanted, found in a cell's scores or its summary.

    Raises:
        StoreError: there is no such sweep.
        ReportError: the record lacks a key or contradicts a cell's identity.
    """
    record = store.sweep_record(sweep_id)
    entries = [_entry(sweep_id, row) for row in record["cells"]]
    ids = sorted({row["cell_id"] for row in entries if row["cell_id"] is not None})
    facts: dict[str, dict[str, Any]] = {}
    scores: list[dict[str, Any]] = []
    made_with: dict[str, set[str]] = {}
    for cell_id in progress(ids, "reading cells", "cell"):
        cell = store.cell(cell_id)
        facts[cell_id] = _facts(cell, metrics)
        if facts[cell_id]["state"] == "done":
            scores += _scores(cell, metrics)
            _gather(made_with, cell.provenance())
    views = _views(scores)
    return Sweep(
        id=sweep_id,
        command=tuple(record["command"]),
        cells=_cells(sweep_id, entries, facts, _cell_means(views), metrics),
        views=views,
        provenance={key: sorted(values) for key, values in sorted(made_with.items())},
    )


def _entry(sweep_id: str, row: Mapping[str, Any]) -> dict[str, Any]:
    missing = [key for key in RECORD_KEYS if key not in row]
    if missing:
        raise ReportError(f"sweeps/{sweep_id}.json: a cell lacks {', '.join(missing)}")
    return {key: row[key] for key in RECORD_KEYS}


def _facts(cell: CellFolder, metrics: Sequence[Metric]) -> dict[str, Any]:
    """A cell's state and, where it is done, its summary and what its identity says of it."""
    state = cell.state()
    if state.name != "done":
        # The report is the same wherever the store lies.
        reason = state.reason.replace(f"{cell.path}/", "")
        return {"state": state.name, "reason": reason or state.name}
    try:
        identity, summary = cell.identity(), cell.summary()
        figures = {m.name: as_number(summary[m.name]) for m in metrics if m.name in summary}
        return figures | {
            "state": "done",
            "reason": "",
            "protocol": int(identity["protocol"]),
            "true_variant": str(identity["variant"]),
            "true_seed": int(identity["seed"]),
        }
    except (StoreError, KeyError, OverflowError, TypeError, ValueError) as error:
        return {"state": "corrupt", "reason": f"identity.json or summary.json: {error!r}"}


def _scores(cell: CellFolder, metrics: Sequence[Metric]) -> list[dict[str, Any]]:
    names = {metric.name for metric in metrics}
    return [
        {"cell_id": cell.id, "view": view} | {k: v for k, v in row.items() if k in names}
        for view, row in cell.view_scores()
    ]


def _views(scores: list[dict[str, Any]]) -> pd.DataFrame:
    if not scores:
        return pd.DataFrame({"cell_id": pd.Series(dtype=str), "view": pd.Series(dtype=str)})
    return pd.DataFrame(scores)


def _cell_means(views: pd.DataFrame) -> pd.DataFrame:
    """Mean of each score over a cell's views; NaN where one view lacks it."""
    grouped = views.drop(columns="view").groupby("cell_id")
    means: pd.DataFrame = grouped.mean()
    return means.mask(grouped.count().lt(grouped.size(), axis=0))


def _cells(
    sweep_id: str,
    entries: list[dict[str, Any]],
    facts: dict[str, dict[str, Any]],
    means: pd.DataFrame,
    metrics: Sequence[Metric],
) -> pd.DataFrame:
    failed = {"state": "failed"}
    rows = [
        row | facts.get(row["cell_id"], failed | {"reason": row["error"] or "no cell was planned"})
        for row in entries
    ]
    columns = [*RECORD_KEYS, "state", "reason", "protocol", "true_variant", "true_seed"]
    cells = pd.DataFrame(rows, columns=[*columns, *(metric.name for metric in metrics)])
    for metric in metrics:
        values = cells[metric.name]
        if metric.name in means.columns:
            values = cells["cell_id"].map(means[metric.name])
        cells[metric.name] = pd.to_numeric(values).astype(np.float64)
    cells["protocol"] = cells["protocol"].astype("Int64")
    _check_identity(sweep_id, cells)
    return cells.drop(columns=["true_variant", "true_seed"])


def _check_identity(sweep_id: str, cells: pd.DataFrame) -> None:
    """A record that says other than the cell itself would pair what is no pair."""
    done = cells[cells["state"] == "done"]
    for key, true in (("variant_id", "true_variant"), ("seed", "true_seed")):
        wrong = done[done[key] != done[true]]
        if not wrong.empty:
            row = wrong.iloc[0]
            raise ReportError(
                f"sweeps/{sweep_id}.json says {key} {row[key]} of cell {row['cell_id']}, "
                f"its identity.json says {row[true]}"
            )


def _gather(found: dict[str, set[str]], provenance: Mapping[str, Any]) -> None:
    """Add a cell's provenance to the distinct values; its moment is no property of the sweep."""
    for key, value in provenance.items():
        if isinstance(value, dict):
            _gather(found, {f"{key}.{name}": inner for name, inner in value.items()})
        elif key != "started":
            found.setdefault(key, set()).add(str(value))
