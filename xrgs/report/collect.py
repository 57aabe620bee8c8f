"""Reads the cells of a sweep from the store into tables; nothing is computed again or trained.

Cells that are not done become rows with their state and reason, so that a report shows them.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Protocol

import msgspec
import numpy as np
import pandas as pd

from xrgs.errors import StoreError, XrgsError
from xrgs.evaluation.scoring import PROTOCOL
from xrgs.experiment.cell_folder import CellState
from xrgs.experiment.provenance import machine
from xrgs.report.curves import cell_curve
from xrgs.report.skipped import cell_work
from xrgs.report.training import cell_totals
from xrgs.runtime.progress import progress
from xrgs.safeio.sanitize import for_line

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from xrgs.evaluation.metrics import Metric
    from xrgs.experiment.cell_folder import CellFolder
    from xrgs.experiment.schema import Provenance

#: Keys of each row of a sweep's record.
RECORD_KEYS = (
    "scene",
    "condition",
    "label",
    "variant_seed",
    "seed",
    "cell_id",
    "variant_id",
    "baseline_id",
    "error",
)


#: Reasons of cells that are not done and did not fail, by the state of their folder. They do not
#: say how far a cell is, which would be another text a second later.
_PENDING = {
    "absent": "not trained yet",
    "planned": "not trained yet",
    "unfinished": "begun and not done yet: it is being trained, or was stopped",
}
_MAX_MACHINE = 120
#: Values of keys that earlier records lack. Those had a swept `variant.seed` in the condition.
_DEFAULTS = {"variant_seed": 0}


class ReportError(XrgsError):
    """A sweep can't be reported; the message names the cells or the file."""


@dataclass(frozen=True)
class Sweep:
    """One sweep as the store holds it: its cells, their scores, and what they were made with."""

    commands: Mapping[str, tuple[str, ...]]
    """The arguments of `xrgs-sweep` by the sweep's id; several where sweeps are joined."""
    cells: pd.DataFrame
    """One row for each entry of the record: its keys, `state`, `reason`, `protocol`, `validation`
    (`train.validation`: 0 where scores are of test views), `machine` (what times depend on beside
    the program, as a text; empty where it is not known), metrics."""
    views: pd.DataFrame
    """One row for each cell and scored view: `cell_id`, `view` and the scores."""
    training: dict[str, dict[str, float]]
    """What training did in each done cell, by its id: `xrgs.report.training.cell_totals`."""
    curves: dict[str, list[dict[str, float]]]
    """Quality during training of each done cell, by its id: `xrgs.report.curves.cell_curve`."""
    work: dict[str, dict[str, float]]
    """What each done cell did in all, by its id: `xrgs.report.skipped.cell_work`."""
    provenance: dict[str, list[str]]
    """Provenance of the done cells: the distinct values of each entry, sorted."""
    renders: dict[str, Path] = field(default_factory=dict)
    """Folders of renders that another program made, by the ids of their rows, which are no cells
    of the store (`xrgs.report.external`)."""

    @property
    def id(self) -> str:
        """The id of the sweep; of several that are joined, all ids with a plus between them."""
        return "+".join(self.commands)


class CellSource(Protocol):
    """Where the cells of a sweep are: a store, or several."""

    def cell(self, cell_id: str) -> CellFolder:
        """Return the folder of a cell, which need not exist.

        Args:
            cell_id: The cell's id.
        """


def read_cells(
    store: CellSource,
    commands: Mapping[str, tuple[str, ...]],
    rows: Sequence[Mapping[str, Any]],
    metrics: Sequence[Metric],
) -> Sweep:
    """Read every cell that rows of records name.

    Args:
        store: Where the cells are.
        commands: The arguments of `xrgs-sweep` by the ids of the sweeps that the rows are from.
        rows: The rows.
        metrics: The metrics to read from each cell's scores or its summary.

    Returns:
        The sweep's tables.

    Raises:
        ReportError: A row lacks a key, or contradicts a cell's identity.
    """
    sweep_id = "+".join(commands)
    entries = [_entry(sweep_id, row) for row in rows]
    ids = sorted({row["cell_id"] for row in entries if row["cell_id"] is not None})
    bar = progress(ids, "reading cells", "cell")
    cells = {cell_id: _read_cell(store.cell(cell_id), metrics) for cell_id in bar}
    done = [cell for cell in cells.values() if cell.columns["state"] == "done"]
    views = _views([row for cell in done for row in cell.scores], metrics)
    provenance: dict[str, set[str]] = {}
    for cell in done:
        _add_provenance(provenance, cell.provenance)
    columns = {cell_id: cell.columns for cell_id, cell in cells.items()}
    return Sweep(
        commands=commands,
        cells=_cells(sweep_id, entries, columns, cell_means(views), metrics),
        views=views,
        training={cell_id: cell.training for cell_id, cell in cells.items()},
        work={cell_id: cell.work for cell_id, cell in cells.items()},
        curves={cell_id: cell.curve for cell_id, cell in cells.items()},
        provenance={key: sorted(values) for key, values in sorted(provenance.items())},
    )


def _entry(sweep_id: str, row: Mapping[str, Any]) -> dict[str, Any]:
    row = _DEFAULTS | dict(row)
    missing = [key for key in RECORD_KEYS if key not in row]
    if missing:
        raise ReportError(f"sweeps/{sweep_id}.json: a cell lacks {', '.join(missing)}")
    return {key: row[key] for key in RECORD_KEYS}


@dataclass(frozen=True)
class _CellContent:
    """What the files of one cell say; of a cell that is not done, its state alone."""

    columns: dict[str, Any]
    """Columns of `Sweep.cells`."""
    scores: list[dict[str, Any]] = field(default_factory=list)
    """Rows of `Sweep.views`."""
    training: dict[str, float] = field(default_factory=dict)
    curve: list[dict[str, float]] = field(default_factory=list)
    work: dict[str, float] = field(default_factory=dict)
    provenance: dict[str, Any] = field(default_factory=dict)


def _read_cell(cell: CellFolder, metrics: Sequence[Metric]) -> _CellContent:
    """Read a cell. One whose files can't be read, or are malformed, is not done."""
    state = cell.state()
    if state.name == "done":
        try:
            training, provenance = cell_totals(cell), cell.provenance()
            return _CellContent(
                _done_columns(cell, metrics) | {"machine": _machine(cell, provenance)},
                _scores(cell, metrics),
                training,
                cell_curve(cell),
                cell_work(cell, training),
                msgspec.structs.asdict(provenance),
            )
        except (StoreError, OSError) as error:
            state = CellState.of_error(error)
    if state.name in _PENDING:
        return _CellContent({"state": "pending", "reason": _PENDING[state.name]})
    # Without the store's path: the report is the same wherever the store is.
    reason = state.reason.replace(f"{cell.path}/", "")
    return _CellContent({"state": state.name, "reason": reason or state.name})


def _done_columns(cell: CellFolder, metrics: Sequence[Metric]) -> dict[str, Any]:
    """Return columns of a finished cell's summary, identity and config."""
    identity, figures = cell.identity(), msgspec.structs.asdict(cell.summary())
    values = {m.name: figures[m.name] for m in metrics if m.name in figures}
    return values | {
        "state": "done",
        "reason": "",
        "protocol": cell.status().scored_by.get(PROTOCOL, ""),
        "validation": float(identity.train.get("validation", 0.0)),
        "true_variant": identity.variant,
        "true_seed": identity.seed,
    }


def _machine(cell: CellFolder, made: Provenance) -> str:
    """Return what a cell's times depend on.

    Several machines that trained a cell in turn get its id: its times are like those of no other.
    """
    turns = made.machines_in_turn
    return for_line(f"cell {cell.id} in turn: {turns}" if turns else machine(made), _MAX_MACHINE)


def _scores(cell: CellFolder, metrics: Sequence[Metric]) -> list[dict[str, Any]]:
    names = {metric.name for metric in metrics}
    return [
        {"cell_id": cell.id, "view": view} | {k: v for k, v in row.items() if k in names}
        for view, row in cell.view_scores()
    ]


def _views(scores: list[dict[str, Any]], metrics: Sequence[Metric]) -> pd.DataFrame:
    """Return the scores as a table, with a column for each score, whether a cell has it or not."""
    names = [metric.name for metric in metrics if metric.score is not None]
    views = pd.DataFrame(scores, columns=["cell_id", "view", *names])
    return views.astype({"cell_id": object, "view": object} | dict.fromkeys(names, np.float64))


def cell_means(views: pd.DataFrame) -> pd.DataFrame:
    """Return the mean of each score over a cell's views, NaN where one view lacks the score.

    Args:
        views: The table `Sweep.views`.

    Returns:
        One row a cell, indexed by its id, with a column for each score.
    """
    grouped = views.drop(columns="view").groupby("cell_id")
    means: pd.DataFrame = grouped.mean()
    return means.mask(grouped.count().lt(grouped.size(), axis=0))


def _cells(
    sweep_id: str,
    entries: list[dict[str, Any]],
    columns: dict[str, dict[str, Any]],
    means: pd.DataFrame,
    metrics: Sequence[Metric],
) -> pd.DataFrame:
    rows = [row | columns.get(row["cell_id"], _without_cell(row["error"])) for row in entries]
    read = ["state", "reason", "protocol", "validation", "machine", "true_variant", "true_seed"]
    names = [*RECORD_KEYS, *read, *(metric.name for metric in metrics)]
    cells = pd.DataFrame(rows, columns=names)
    for metric in metrics:
        values = cells[metric.name]
        if metric.name in means.columns:
            values = cells["cell_id"].map(means[metric.name])
        cells[metric.name] = pd.to_numeric(values).astype(np.float64)
    cells["protocol"] = cells["protocol"].astype(object).fillna("")
    cells["validation"] = cells["validation"].astype(np.float64)
    cells["machine"] = cells["machine"].astype(object).fillna("")
    _check_identity(sweep_id, cells)
    return cells.drop(columns=["true_variant", "true_seed"])


def _without_cell(error: str | None) -> dict[str, str]:
    """Return state and reason of a row that has no cell: it can't be trained, or not yet."""
    if error:
        return {"state": "failed", "reason": error}
    return {"state": "pending", "reason": "not trained yet: it waits for another cell's count"}


def _check_identity(sweep_id: str, cells: pd.DataFrame) -> None:
    """Refuse a record that contradicts a cell: it would pair cells that do not belong together."""
    done = cells[cells["state"] == "done"]
    for key, true in (("variant_id", "true_variant"), ("seed", "true_seed")):
        contradicted = done[done[key] != done[true]]
        if not contradicted.empty:
            row = contradicted.iloc[0]
            raise ReportError(
                f"sweeps/{sweep_id}.json says {key} {row[key]} of cell {row['cell_id']}, "
                f"its identity.json says {row[true]}"
            )


def _add_provenance(distinct: dict[str, set[str]], provenance: Mapping[str, Any]) -> None:
    """Add a cell's provenance to the distinct values, but for the time at which it started."""
    for key, value in provenance.items():
        if isinstance(value, dict):
            _add_provenance(distinct, {f"{key}.{name}": inner for name, inner in value.items()})
        elif key != "started":
            distinct.setdefault(key, set()).add(str(value))
