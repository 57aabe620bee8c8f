"""Reads the records and the cells of a report's sweeps into tables; nothing is trained or scored.

A study may be trained in parts, for example scene by scene: its report needs the rows of all
records. A cell that is not done becomes a row with its state and the reason, so that a report shows
it.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from statistics import fmean
from types import MappingProxyType
from typing import Any

import msgspec
import numpy as np
import pandas as pd

from xrgs.composing import dotted
from xrgs.config import Conf
from xrgs.errors import StoreError, UnreadableError, XrgsError
from xrgs.evaluation.metrics import METRICS, ON_REQUEST, VIEW_METRICS
from xrgs.runtime.progress import progress
from xrgs.safeio.sanitize import for_file_name, for_line
from xrgs.store.cell_folder import HISTORY, CellFolder, CellState, number_columns
from xrgs.store.inspect import SfmReport
from xrgs.store.provenance import machine
from xrgs.store.results import over_views
from xrgs.store.schema import Identity, Provenance, RecordedCell, Status, Summary
from xrgs.store.scoring import PROTOCOL, stale_scores, without_refactorings
from xrgs.store.store import BASELINE, Store

#: The columns of a sweep's record, which has a row for each planned cell.
RECORD_KEYS = [
    *("scene", "condition", "label", "variant_seed", "seed"),
    *("cell_id", "variant_id", "baseline_id", "error"),
]
#: The columns that name a cell in tables of training and curves.
CELL_KEYS = ["cell_id", "scene", "label", "condition", "variant_seed", "seed"]
#: Scores of views that a cell may have.
_SCORES = (*VIEW_METRICS, *sorted(ON_REQUEST))
#: Columns of `quality.csv`: steps done, time and alpha evaluations so far, Gaussians, mean scores.
CURVE_COLUMNS = ["step", "seconds", "evaluations", "gaussians", *VIEW_METRICS]
#: Columns of a history that describe only the logged step; the others count from the first step.
_SINGLE_STEP_COLUMNS = frozenset({"step", "loss", "gaussians"})

#: State of a cell's folder -> the reason in tables, for cells that are not done and did not fail.
#: How far a cell is would change the report every second, so it is left out.
_PENDING = {
    "absent": "not trained yet",
    "planned": "not trained yet",
    "unfinished": "begun and not done yet: it is being trained, or was stopped",
}
_MAX_MACHINE = 120


class ReportError(XrgsError):
    """A sweep can't be reported; the message names the cells or the file."""


@dataclass(frozen=True)
class DoneCell:
    """The content of a done cell's files."""

    status: Status
    identity: Identity
    summary: Summary
    provenance: Provenance
    config: Conf | None
    """None if this version of xrgs can't read it."""
    scores: list[tuple[str, dict[str, float]]]
    """The name and the scores of each view."""
    totals: dict[str, float]
    """The counts of its history at the end of training, and means of components' logged values."""
    curve: list[dict[str, float]]
    """A row of `CURVE_COLUMNS` for each evaluation during training (none without
    `train.evaluate_every`), and a last row for the trained cell."""


@dataclass(frozen=True)
class Sweep:
    """A sweep, or several that are joined, as the store holds them: cells, scores, provenance."""

    commands: Mapping[str, tuple[str, ...]]
    """The id of each sweep -> the arguments of `xrgs-sweep`."""
    cells: pd.DataFrame
    """One row for each entry of the record, with these columns:

    - `RECORD_KEYS`, `state` and `reason`;
    - `protocol` and `<score>_code`: digests of the code that has rendered and scored the views;
    - `stale`: names of the scores that are missing, or that other code than the installed computed;
    - `validation`: `train.validation`; 0 if test views are scored;
    - `steps`, `long_side` (px) and `factor` of the config;
    - `machine`: processor, threads and the like, on which times depend; empty if unknown;
    - each metric by its name."""
    views: pd.DataFrame
    """One row for each cell and scored view: `cell_id`, `view` and the scores."""
    done: dict[str, DoneCell]
    """The files of the cells that are done, by the cell's id."""
    renders: dict[str, Path] = field(default_factory=dict)
    """Folders of another program's renders, by the `cell_id` of their rows in `cells`. The store
    has no such cells (`xrgs.report.external`)."""
    variants: dict[str, SfmReport] = field(default_factory=dict)
    """The SfM reports of the done cells' variants, by the variant's id
    (`xrgs.report.context`)."""

    @property
    def id(self) -> str:
        """The id of the sweep, or the ids of all joined sweeps, with `+` between them."""
        return "+".join(self.commands)

    @property
    def provenance(self) -> dict[str, list[str]]:
        """Provenance of the done cells: the distinct values of each entry, sorted."""
        distinct: dict[str, set[str]] = {}
        for cell in self.done.values():
            for key, value in dotted(msgspec.structs.asdict(cell.provenance)):
                if key != "started":
                    distinct.setdefault(key, set()).add(str(value))
        return {key: sorted(values) for key, values in sorted(distinct.items())}


def read_cells(
    store: Store, commands: Mapping[str, tuple[str, ...]], rows: Sequence[RecordedCell]
) -> Sweep:
    """Read every cell of the rows of sweeps' records.

    Raises:
        ReportError: A row contradicts its cell's identity.
    """
    ids = sorted({row.cell_id for row in rows if row.cell_id is not None})
    done: dict[str, DoneCell] = {}
    columns: dict[str, dict[str, Any]] = {}
    for cell_id in progress(ids, "reading cells", "cell"):
        cell = _read_cell(store.cell(cell_id))
        if isinstance(cell, DoneCell):
            done[cell_id] = cell
            columns[cell_id] = _done_columns(cell_id, cell)
        else:
            columns[cell_id] = {"state": cell.name, "reason": cell.reason}
    _check_identity("+".join(commands), rows, done)
    views = _views(done)
    return Sweep(
        commands, _cells(rows, columns, over_views(views.drop(columns="view"))), views, done
    )


def _read_cell(cell: CellFolder) -> DoneCell | CellState:
    """Read a cell, or return its state if it is not done or its files can't be read."""
    state = cell.state()
    if state.name == "done":
        try:
            return _read_done(cell)
        except (StoreError, OSError) as error:
            state = CellState.of_error(error)
    if state.name in _PENDING:
        return CellState("pending", _PENDING[state.name])
    # The report must not depend on where the store is.
    reason = state.reason.replace(f"{cell.path}/", "")
    return CellState(state.name, reason or state.name)


def _read_done(cell: CellFolder) -> DoneCell:
    summary, scores = cell.summary(), cell.view_scores()
    try:
        config = cell.config()
    except UnreadableError:
        raise
    except XrgsError:
        config = None
    return DoneCell(
        status=cell.status(),
        identity=cell.identity(),
        summary=summary,
        provenance=cell.provenance(),
        config=config,
        scores=scores,
        totals=_totals(number_columns(cell.path / HISTORY)),
        curve=_curve(cell.path / "quality.csv", summary, scores),
    )


def _totals(history: Mapping[str, list[float]]) -> dict[str, float]:
    """Return `DoneCell.totals`."""
    totals = {}
    for name, column in history.items():
        if not column or name in _SINGLE_STEP_COLUMNS:
            continue
        if is_component_log(name):
            values = [value for value in column if not math.isnan(value)]
            if values:
                totals[name] = fmean(values)
        else:
            totals[name] = column[-1]  # counts start at the first step
    return totals


def is_component_log(column: str) -> bool:
    """Return whether a component logged a column, which is then named `<component>.<value>`."""
    return "." in column


def _curve(
    file: Path, summary: Summary, views: list[tuple[str, dict[str, float]]]
) -> list[dict[str, float]]:
    """Return `DoneCell.curve`; a missing score is NaN. StoreError says that the file is damaged."""
    last: dict[str, float] = {
        "step": summary.steps,
        "seconds": summary.training_time_s,
        "evaluations": summary.evaluations,
        "gaussians": summary.gaussians,
    }
    for name in VIEW_METRICS:
        values = [scores.get(name, math.nan) for _, scores in views]
        last[name] = fmean(values) if values else math.nan
    if not file.is_file():
        return [last]
    columns = number_columns(file)
    if missing := [name for name in CURVE_COLUMNS[:4] if name not in columns]:
        raise StoreError(f"damaged: {file}: there is no column {', '.join(missing)}")
    count = len(columns["step"])
    absent = [math.nan] * count
    return [
        {name: columns.get(name, absent)[at] for name in CURVE_COLUMNS} for at in range(count)
    ] + [last]


def _done_columns(cell_id: str, cell: DoneCell) -> dict[str, Any]:
    """Return the columns of `Sweep.cells` for a done cell, without its scores."""
    figures = msgspec.structs.asdict(cell.summary)
    train, (scored_by, stale) = cell.identity.train, _scored(*cell.status.scored_by.items())
    variant = cell.config.variant if cell.config else None
    # Times of several machines in turn can't be compared with those of any other cell.
    turns = cell.provenance.machines_in_turn
    machine_name = f"cell {cell_id} in turn: {turns}" if turns else machine(cell.provenance)
    return {
        **{metric.name: figures[metric.name] for metric in METRICS if metric.name in figures},
        **{f"{name}_code": scored_by.get(name, "") for name in _SCORES},
        "state": "done",
        "reason": "",
        "protocol": scored_by.get(PROTOCOL, ""),
        "stale": stale,
        "validation": train.get("validation", 0.0),
        "steps": cell.summary.steps,
        "long_side": variant.long_side if variant else None,
        "factor": variant.factor if variant else None,
        "machine": for_line(machine_name, _MAX_MACHINE),
    }


@cache
def _scored(*digests: tuple[str, str]) -> tuple[Mapping[str, str], str]:
    """Return the digests of scores without refactorings, and the names of the stale scores."""
    scored_by = without_refactorings(dict(digests))
    return MappingProxyType(scored_by), " ".join(stale_scores(scored_by))


def _views(done: Mapping[str, DoneCell]) -> pd.DataFrame:
    """Return `Sweep.views`; it has a column even for scores that no cell has."""
    rows = [(cell_id, view, of) for cell_id, cell in done.items() for view, of in cell.scores]
    texts = {name: [row[at] for row in rows] for at, name in enumerate(("cell_id", "view"))}
    scores = {name: [of.get(name, math.nan) for _, _, of in rows] for name in _SCORES}
    columns = {name: pd.Series(values, dtype=object) for name, values in texts.items()}
    columns |= {name: pd.Series(values, dtype=np.float64) for name, values in scores.items()}
    return pd.DataFrame(columns, copy=False)  # one block a column, whose means sum by rows


def _cells(
    rows: Sequence[RecordedCell], columns: Mapping[str, dict[str, Any]], means: pd.DataFrame
) -> pd.DataFrame:
    """Return `Sweep.cells`: the rows of the record with the columns of their cells."""
    texts = ["state", "reason", "protocol", *(f"{name}_code" for name in _SCORES)]
    texts += ["stale", "machine"]
    numbers = ["validation", "steps", "long_side", "factor", *(metric.name for metric in METRICS)]
    entries = [
        {key: getattr(row, key) for key in RECORD_KEYS}
        | (columns[row.cell_id] if row.cell_id else _without_cell(row))
        for row in rows
    ]
    cells = pd.DataFrame(entries, columns=[*RECORD_KEYS, *texts, *numbers])
    for name in means.columns:
        cells[name] = cells["cell_id"].map(means[name])
    cells[texts] = cells[texts].astype(object).fillna("")
    return cells.astype(dict.fromkeys(numbers, np.float64))


def _without_cell(row: RecordedCell) -> dict[str, str]:
    """Return state and reason of a row without a cell id."""
    if row.error:
        return {"state": row.state or "failed", "reason": row.error}
    return {"state": "pending", "reason": "not trained yet: it waits for another cell's count"}


def _check_identity(
    sweep_id: str, rows: Iterable[RecordedCell], done: Mapping[str, DoneCell]
) -> None:
    """Refuse a record whose variant or seed is not the cell's: it would pair the wrong cells."""
    for row in rows:
        cell = done.get(row.cell_id or "")
        if cell is None:
            continue
        identity = cell.identity
        for key, recorded, actual in (
            ("variant_id", row.variant_id, identity.variant),
            ("seed", row.seed, identity.seed),
        ):
            if recorded != actual:
                raise ReportError(
                    f"sweeps/{sweep_id}.json says {key} {recorded} of cell {row.cell_id}, "
                    f"its identity.json says {actual}"
                )


#: The most ids in the name of a report's folder.
_MAX_LISTED = 4


@dataclass(frozen=True)
class Choice:
    """The scenes and ablations that a report shows."""

    scenes: tuple[str, ...] = ()
    """Names of scenes; empty for all."""
    ablations: tuple[str, ...] = ()
    """Labels of ablations and controls, beside their base; empty for all."""

    def rows(self, rows: Sequence[tuple[str, RecordedCell]], against: str) -> list[RecordedCell]:
        """Return the chosen rows of `sweep_records`, each run once; `against` and baselines stay.

        Raises:
            ReportError: No row has a chosen scene or label; the message lists the existing ones.
                Or two records have different cells for one run; the message names both.
        """
        _check_known("scenes", self.scenes, [row.scene for _, row in rows])
        _check_known("ablations", self.ablations, [row.label for _, row in rows])
        labels = {*self.ablations, against, BASELINE}
        chosen: dict[tuple[object, ...], tuple[str, RecordedCell]] = {}
        for sweep_id, row in rows:
            if self.scenes and row.scene not in self.scenes:
                continue
            if self.ablations and row.label not in labels:
                continue
            key = (row.scene, row.condition, row.label, row.variant_seed, row.seed)
            chosen[key] = sweep_id, _fuller(chosen.get(key), sweep_id, row)
        return [row for _, row in chosen.values()]

    @property
    def suffix(self) -> str:
        """The end of the report's folder name that tells the choice; empty if all is chosen."""
        parts = (("scenes", self.scenes), ("ablations", self.ablations))
        return "".join(f".{key}-{for_file_name(','.join(names))}" for key, names in parts if names)


def _check_known(key: str, wanted: Iterable[str], choices: Sequence[str]) -> None:
    for name in wanted:
        if name not in choices:
            raise ReportError(
                f"{key}={name}: the sweep has none of that name; choose from:"
                f" {', '.join(dict.fromkeys(choices))}"
            )


class ReportStore(Store):
    """A store with the renders of other programs, from which a report is made."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self.external: Mapping[str, Path] = {}
        """Folders of another program's renders, see `Sweep.renders`."""

    def render(self, cell_id: str, view: str) -> Path:
        """Return the file of a view's render, which need not exist; StoreError if it is trimmed."""
        if cell_id in self.external:
            return self.external[cell_id] / f"{view}.png"
        cell, name = self.cell(cell_id), f"renders/{view}.png"
        cell.check_not_trimmed(name)
        return cell.path / name

    def without_paths(self, text: str) -> str:
        """Remove the store's path from a text, so that reports don't depend on it."""
        return text.replace(f"{self.path}/", "")

    def sweep_records(
        self, sweep_ids: Sequence[str]
    ) -> tuple[dict[str, tuple[str, ...]], list[tuple[str, RecordedCell]]]:
        """Return the command of each sweep, by its id, and the rows of all records with the id.

        Raises:
            StoreError: There is no such sweep, or its record is damaged.
        """
        records = {sweep_id: self.sweep_record(sweep_id) for sweep_id in sweep_ids}
        commands = {sweep_id: record.command for sweep_id, record in records.items()}
        return commands, [(name, row) for name, record in records.items() for row in record.cells]


def _fuller(old: tuple[str, RecordedCell] | None, sweep_id: str, row: RecordedCell) -> RecordedCell:
    """Return, of two rows for one run, the one with a cell id; refuse two different cells."""
    if old is None or old[1].cell_id is None:
        return row
    before, first = old
    if row.cell_id in {None, first.cell_id}:
        return first
    name = " / ".join(filter(None, (row.scene, row.label, row.condition)))
    raise ReportError(
        f"{name} / seed {row.seed} is cell {first.cell_id} in sweep {before} and"
        f" {row.cell_id} in sweep {sweep_id}: they differ in configuration, code or variant."
        " Leave one of the sweeps out, or choose rows with --scenes and --ablations. To compare two"
        " values of a setting, run xrgs-sweep with both as an axis: finished cells are not trained"
        " again"
    )


def report_name(sweep_ids: Sequence[str]) -> str:
    """Return the name of a report's folder: the ids of its sweeps, joined by `+`."""
    more = len(sweep_ids) - _MAX_LISTED
    listed = "+".join(sweep_ids[:_MAX_LISTED])
    return f"{listed}+{for_file_name(' '.join(sweep_ids[_MAX_LISTED:]))}" if more > 0 else listed
