"""The store: a folder that keeps variants, trained cells, sweep records and reports.

Its subfolders are `scenes/`, `variants/`, `cells/<cell id>/`, `locks/`, `hydra/` (one folder per
call of `xrgs-sweep`), `sweeps/<sweep id>.json` and `reports/<sweep id>/`. The files of a cell are
described in `xrgs.experiment.cell_folder`.
"""

from __future__ import annotations

import os
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from xrgs.errors import StoreError
from xrgs.experiment.cell_folder import CellFolder
from xrgs.safeio import untrusted
from xrgs.safeio.atomic import write_json
from xrgs.safeio.hashing import digest
from xrgs.safeio.records import read_json
from xrgs.safeio.words import for_line

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    import pandas as pd


#: Label of the cells that all others are compared to.
BASELINE = "baseline"

_RECORD_VERSION = 1
#: Bytes that must be writable before a sweep starts; any cell needs more than that.
_MIN_FREE_BYTES = 1 << 15
_MAX_SEED = (1 << 63) - 1


@dataclass(frozen=True)
class Store:
    """A store: everything that sweeps keep, in one folder."""

    path: Path
    """The folder."""

    def __init__(self, path: str | Path) -> None:
        object.__setattr__(self, "path", Path(path))

    @property
    def scenes(self) -> Path:
        """Folder of the rendered photographs of procedural scenes."""
        return self.path / "scenes"

    @property
    def variants(self) -> Path:
        """Folder of the frozen variants."""
        return self.path / "variants"

    @property
    def cells_folder(self) -> Path:
        """Folder of the cells."""
        return self.path / "cells"

    @property
    def locks(self) -> Path:
        """Folder of the locks of cells that are being trained."""
        return self.path / "locks"

    @property
    def reports(self) -> Path:
        """Folder of the reports: tables and figures."""
        return self.path / "reports"

    def prepare(self) -> None:
        """Create the subfolders, and check that the disk has room.

        Raises:
            StoreError: The folder can't be written; the message names it and the `store` key.
        """
        try:
            folders = (
                self.scenes,
                self.variants,
                self.cells_folder,
                self.locks,
                self.path / "sweeps",
            )
            for folder in folders:
                folder.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryFile(dir=self.path) as file:
                file.write(bytes(_MIN_FREE_BYTES))
        except OSError as error:
            raise StoreError(
                f"store={self.path} can't be written ({error}): choose another with store=..."
            ) from error

    def cell(self, cell_id: str) -> CellFolder:
        """Return the folder of a cell, which need not exist.

        Args:
            cell_id: The cell's id.

        Raises:
            StoreError: The id is not a valid name of a folder.
        """
        if not untrusted.is_name(cell_id):
            raise StoreError(f"{cell_id!r:.80} is not the id of a cell")
        return CellFolder(self.cells_folder / cell_id)

    def cells(self, *, verify: bool = True) -> pd.DataFrame:
        """List the cells: what they are, whether they are done, and how they scored.

        `table.loc[:, table.astype(str).nunique() > 1]` keeps the columns in which cells differ.

        Args:
            verify: Compare the hashes of each cell's results, and not only the sizes of its files.

        Returns:
            One row a cell, sorted by scene, label, condition, seed and id, with the columns
            `cell_id`; `scene`, `label` and `condition` as the latest sweep with the cell named it
            (missing where no sweep has it); `seed`; `variant` (its id); `state` and `reason` as of
            `CellFolder.state`; each metric of `xrgs.evaluation.metrics.METRICS`, of the whole cell
            or its mean over test views (NaN where there is none); and each value of its config by
            its key, as `train.steps`.

        Raises:
            StoreError: There is no such store, or a sweep's record in it can't be read.
        """
        from xrgs.experiment.results import cell_columns, cell_metrics, cells_table

        if not self.cells_folder.is_dir():
            raise StoreError(f"{self.path}: no store; xrgs-sweep makes one with store={self.path}")
        names, rows = self.recorded_names(), []
        for entry in os.scandir(self.cells_folder):
            # The name of a folder that was set aside has a dot.
            if not entry.is_dir() or "." in entry.name or not untrusted.is_name(entry.name):
                continue
            cell = self.cell(entry.name)
            state = cell.state(verify=verify)
            row = cell_columns(cell.path, names.get(cell.id, {}))
            row |= {"state": state.name, "reason": for_line(state.reason)}
            done = state.name == "done"
            rows.append(row | (cell_metrics(cell.path, cell.scores()) if done else {}))
        return cells_table(rows)

    def recorded_names(self) -> dict[str, dict[str, str]]:
        """Return scene, label and condition of each cell that a sweep recorded, by the cell's id.

        A cell of several sweeps has the names that the latest one gave it.

        Raises:
            StoreError: A sweep's record can't be read; the message names it.
        """
        from xrgs.experiment.results import CELL_NAMES

        files = (self.path / "sweeps").glob("*.json")
        names: dict[str, dict[str, str]] = {}
        for file in sorted(files, key=lambda file: (file.stat().st_mtime_ns, file.name)):
            for row in self.sweep_record(file.stem)["cells"]:
                if row.get("cell_id") is not None:
                    texts = {key: for_line(row.get(key, "")) for key in CELL_NAMES}
                    names[row["cell_id"]] = texts
        return names

    def write_sweep(self, command: Sequence[str], cells: Iterable[Mapping[str, Any]]) -> str:
        """Record which cells a sweep compared, for its report.

        Args:
            command: Arguments of `xrgs-sweep`.
            cells: One row for each cell, as `xrgs.sweep.plan.record` makes them.

        Returns:
            The id of the record; the same rows give the same id.
        """
        rows = [dict(cell) for cell in cells]
        sweep_id = digest(rows)
        record = {"version": _RECORD_VERSION, "command": list(command), "cells": rows}
        write_json(self.path / "sweeps" / f"{sweep_id}.json", record)
        return sweep_id

    def latest_sweep(self) -> str:
        """Return the id of the sweep that was recorded last.

        Raises:
            StoreError: The store has no record of a sweep.
        """
        records = list((self.path / "sweeps").glob("*.json"))
        if not records:
            raise StoreError(f"store={self.path} holds no sweep: run xrgs-sweep first")
        return max(records, key=lambda file: (file.stat().st_mtime_ns, file.name)).stem

    def sweep_record(self, sweep_id: str | None = None) -> dict[str, Any]:
        """Return the record of a sweep.

        Args:
            sweep_id: The id of the record; None for the latest.

        Returns:
            `version`, `command` (the arguments of `xrgs-sweep`) and `cells` (one row per cell).

        Raises:
            StoreError: There is no such record, or it is malformed or of another version.
        """
        sweep_id = sweep_id or self.latest_sweep()
        if not untrusted.is_name(sweep_id):
            raise StoreError(f"{sweep_id!r:.80} is not the id of a sweep")
        file = self.path / "sweeps" / f"{sweep_id}.json"
        record = read_json(file)
        if not isinstance(record, dict) or record.get("version") != _RECORD_VERSION:
            raise StoreError(f"{file} is not a sweep record of version {_RECORD_VERSION}")
        command, cells = record.get("command"), record.get("cells")
        if not _is_list(command, str) or not isinstance(cells, list):
            raise StoreError(f"{file}: command or cells is missing or malformed")
        wrong = [number for number, row in enumerate(cells) if not _is_row(row)]
        if wrong:
            raise StoreError(f"{file}: cell {wrong[0] + 1} has a value of a wrong type or form")
        return record


def _is_list(value: object, kind: type) -> bool:
    return isinstance(value, list) and all(isinstance(inner, kind) for inner in value)


def _is_row(row: object) -> bool:
    """Return whether the values that a record has for a cell are of the right types."""
    if not isinstance(row, dict):
        return False
    texts = [row.get(key, "") for key in ("scene", "label", "condition")]
    ids = [row.get(key) for key in ("cell_id", "variant_id", "baseline_id")]
    seed, error = row.get("seed", 0), row.get("error")
    return (
        _is_list([*texts, error or ""], str)
        and all(one is None or untrusted.is_name(one) for one in ids)
        and type(seed) is int
        and 0 <= seed <= _MAX_SEED
    )
