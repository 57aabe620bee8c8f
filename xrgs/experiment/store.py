"""The store: a folder that keeps variants, trained cells, sweep records and reports.

Its subfolders are `scenes/`, `variants/`, `cells/<cell id>/`, `locks/`, `hydra/` (one folder per
call of `xrgs-sweep`), `sweeps/<sweep id>.json` and `reports/<sweep id>/`. The files of a cell are
described in `xrgs.experiment.cell_folder`.
"""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from xrgs.capture.failures import FAILED_PREFIX
from xrgs.errors import StoreError, UnreadableError
from xrgs.experiment.cell_folder import READING_ERRORS, CellFolder, CellState
from xrgs.runtime.progress import log_line
from xrgs.safeio import untrusted
from xrgs.safeio.atomic import write_json
from xrgs.safeio.confined import ConfinedPath, RootMissingError
from xrgs.safeio.hashing import digest
from xrgs.safeio.records import list_folder, read_json
from xrgs.safeio.words import for_line

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    import pandas as pd


#: Label of the cells that all others are compared to.
BASELINE = "baseline"

_RECORD_VERSION = 1
#: The largest record of a sweep that is read, in bytes: 100,000 cells take 30 MB.
_MAX_RECORD_BYTES = 1 << 25
#: The longest scene, label or condition of a record, in characters.
_MAX_NAME = 2000
#: Bytes that must be writable before a sweep starts; any cell needs more than that.
_MIN_FREE_BYTES = 1 << 15
_MAX_SEED = (1 << 63) - 1
#: The most ids of cells that a message lists.
_MAX_LISTED = 6


@dataclass(frozen=True)
class Store:
    """A store: everything that sweeps keep, in one folder."""

    path: Path
    """The folder."""

    def __init__(self, path: str | Path) -> None:
        object.__setattr__(self, "path", Path(path))

    @property
    def folder(self) -> ConfinedPath:
        """The folder as the root of everything in it, which may come from anybody."""
        return ConfinedPath(self.path)

    @property
    def scenes(self) -> ConfinedPath:
        """Folder of the rendered photographs of procedural scenes."""
        return self.folder / "scenes"

    @property
    def variants(self) -> ConfinedPath:
        """Folder of the frozen variants."""
        return self.folder / "variants"

    @property
    def cells_folder(self) -> ConfinedPath:
        """Folder of the cells."""
        return self.folder / "cells"

    @property
    def locks(self) -> ConfinedPath:
        """Folder of the locks of cells that are being trained."""
        return self.folder / "locks"

    @property
    def sweeps(self) -> ConfinedPath:
        """Folder of the records of sweeps."""
        return self.folder / "sweeps"

    @property
    def reports(self) -> ConfinedPath:
        """Folder of the reports: tables and figures."""
        return self.folder / "reports"

    @property
    def exists(self) -> bool:
        """Whether the folder is a store: whether it is there and has a folder of cells.

        Raises:
            StoreError: It can't be told now; the message names the folder.
        """
        try:
            return self.cells_folder.is_dir()
        except (RootMissingError, NotADirectoryError):
            return False
        except OSError as error:
            raise UnreadableError(f"store={self.path}: {error.strerror}; try again") from error

    def prepare(self) -> None:
        """Create the folder and its subfolders, and check that the disk has room.

        Raises:
            StoreError: The folder can't be written; the message names it and the `store` key.
        """
        try:
            self.folder.make_root()
            for folder in (self.scenes, self.variants, self.cells_folder, self.locks, self.sweeps):
                folder.make_folder()
            self.cells_folder.sync_name()  # and the names of the others, which are beside it
        except OSError as error:
            raise self._unwritable(error) from error
        self.check_room()

    def check_room(self) -> None:
        """Check that the disk has room, without creating the folder.

        Raises:
            StoreError: As `prepare`.
        """
        self._write_nameless(self.path)

    def check_writable(self) -> None:
        """Check that `prepare` could write, and leave nothing behind.

        Raises:
            StoreError: As `prepare`.
        """
        folder = self.path.absolute()
        while not folder.exists() and not folder.is_symlink():
            folder = folder.parent
        self._write_nameless(folder)

    def _write_nameless(self, folder: Path) -> None:
        """Write a file that has no name into a folder, and so leave nothing behind."""
        try:
            with tempfile.TemporaryFile(dir=folder) as file:
                file.write(bytes(_MIN_FREE_BYTES))
        except OSError as error:
            error.filename = str(folder)  # and not the name of the file, which is random
            raise self._unwritable(error) from error

    def _unwritable(self, error: OSError) -> StoreError:
        return StoreError(
            f"store={self.path} can't be written ({error.strerror}: {error.filename}): choose"
            " another with store=..."
        )

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

    def variant(self, variant_id: str) -> ConfinedPath:
        """Return the folder of a variant, which need not exist.

        Args:
            variant_id: The variant's id.

        Raises:
            StoreError: The id is not a valid name of a folder.
        """
        if not untrusted.is_name(variant_id):
            raise StoreError(f"{variant_id!r:.80} is not the id of a variant")
        return self.variants / variant_id

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
            StoreError: There is no such store, or its cells can't be listed. A sweep's record that
                can't be read is named on stderr.
        """
        from xrgs.experiment.results import cell_columns, cell_metrics, cells_table

        if not self.exists:
            raise StoreError(f"{self.path}: no store; xrgs-sweep makes one with store={self.path}")
        names, rows = self.cell_names(), []
        for cell in self.cell_folders():
            state, metrics = cell.state(verify=verify), {}
            if state.name == "done":
                try:
                    metrics = cell_metrics(cell.summary(), cell.scores())
                except READING_ERRORS as error:
                    state = CellState.of_error(error)
            row: dict[str, Any] = cell_columns(cell.folder, names.get(cell.id, {}))
            rows.append(row | metrics | {"state": state.name, "reason": for_line(state.reason)})
        return cells_table(rows)

    def find_cell(self, beginning: str) -> CellFolder:
        """Return the cell whose id begins with a text.

        Args:
            beginning: The id, or so much of it that it is that of one cell.

        Raises:
            StoreError: There is no store, no id begins with it, or several do.
        """
        if not self.exists:
            raise StoreError(f"store={self.path} is not a store; xrgs-sweep makes one")
        return self.cell(full_id(beginning, [cell.id for cell in self.cell_folders()]))

    def find_folder(self, beginning: str) -> ConfinedPath:
        """Return the folder of the cell or the variant whose id begins with a text.

        Args:
            beginning: The id, or so much of it that it is that of one cell or variant.

        Raises:
            StoreError: There is no store, no id begins with it, or several do.
        """
        if not self.exists:
            raise StoreError(f"store={self.path} is not a store; xrgs-sweep makes one")
        variants = [
            self.variant(name)
            for name in list_folder(self.variants)
            if "." not in name and not name.startswith(FAILED_PREFIX) and untrusted.is_name(name)
        ]
        folders = {folder.name: folder for folder in variants}
        folders |= {cell.id: cell.folder for cell in self.cell_folders()}
        return folders[full_id(beginning, list(folders), "cells or variants")]

    def cell_folders(self) -> list[CellFolder]:
        """Return the cells, sorted by id; folders of earlier attempts, whose names have a dot, not.

        Whatever else has the name of a cell is among them, a link or a file: its state says so.

        Raises:
            StoreError: The folder of cells can't be listed; the message names it.
        """
        names = list_folder(self.cells_folder)
        return [self.cell(name) for name in names if "." not in name and untrusted.is_name(name)]

    def cell_names(self) -> dict[str, dict[str, str]]:
        """Return scene, label and condition of recorded cells by id, as the latest sweep has it.

        A sweep's record that can't be read is named on stderr, and left out.
        """
        from xrgs.experiment.results import CELL_NAMES

        try:
            records, damaged = self.records()
        except StoreError as error:
            records, damaged = {}, (str(error),)
        for message in damaged:
            log_line(f"{message}; its names of cells are left out")
        return {
            row["cell_id"]: {key: for_line(row.get(key, "")) for key in CELL_NAMES}
            for record in records.values()
            for row in record["cells"]
            if row.get("cell_id") is not None
        }

    def sweep_ids(self) -> list[str]:
        """Return the ids of the recorded sweeps, oldest first.

        Raises:
            StoreError: The folder of the records can't be listed; the message names it.
        """
        names = [name for name in list_folder(self.sweeps) if name.endswith(".json")]
        files = [self.sweeps / name for name in names if untrusted.is_name(name)]
        times = {file.stem: _modified_ns(file) for file in files}
        return sorted(times, key=lambda sweep_id: (times[sweep_id], sweep_id))

    def records(self) -> tuple[dict[str, dict[str, Any]], tuple[str, ...]]:
        """Read the records of all sweeps.

        Returns:
            The records that can be read, by the sweep's id, oldest first, and for each other one a
            message that names its file.

        Raises:
            StoreError: As `sweep_ids`.
        """
        records, damaged = {}, []
        for sweep_id in self.sweep_ids():
            try:
                records[sweep_id] = self.sweep_record(sweep_id)
            except StoreError as error:
                damaged.append(str(error))
        return records, tuple(damaged)

    def write_sweep(
        self,
        command: Sequence[str],
        cells: Iterable[Mapping[str, Any]],
        sweep_id: str | None = None,
    ) -> str:
        """Record which cells a sweep compares, for its report: when it starts, and at its end.

        Args:
            command: Arguments of `xrgs-sweep`.
            cells: One row for each cell, as `xrgs.sweep.plan.record` makes them.
            sweep_id: The id that the sweep has already, whose record is replaced; None when it
                starts.

        Returns:
            The id of the record. A sweep that asks for the same has the same id, however many of
            its cells are done.
        """
        rows = [dict(cell) for cell in cells]
        sweep_id = sweep_id or digest([_asked_for(row) for row in rows])
        record = {
            "version": _RECORD_VERSION,
            "command": list(command),
            "cells": rows,
            "digest": digest(rows),
        }
        write_json(self.sweeps / f"{sweep_id}.json", record)
        return sweep_id

    def latest_sweep(self) -> str:
        """Return the id of the sweep that was recorded last, of those that can be read.

        A newer record that can't be read is named on stderr.

        Raises:
            StoreError: There is no store, or it has no record of a sweep, or none that can be read.
        """
        if not self.exists:
            raise StoreError(f"store={self.path} is not a store; xrgs-sweep makes one")
        sweep_ids = self.sweep_ids()
        if not sweep_ids:
            raise StoreError(f"store={self.path} holds no sweep: run xrgs-sweep first")
        damaged = []
        for sweep_id in reversed(sweep_ids):
            try:
                self.sweep_record(sweep_id)
            except StoreError as error:
                damaged.append(error)
                continue
            for newer in damaged:
                log_line(f"{newer}; the sweep before it is taken")
            return sweep_id
        raise damaged[0]

    def sweep_record(self, sweep_id: str | None = None) -> dict[str, Any]:
        """Return the record of a sweep.

        Args:
            sweep_id: The id of the record; None for the latest.

        Returns:
            `version`, `command` (the arguments of `xrgs-sweep`), `cells` (one row per cell) and
            `digest` (of the cells; records of earlier versions lack it).

        Raises:
            StoreError: There is no such record, or it is malformed or of another version.
        """
        sweep_id = sweep_id or self.latest_sweep()
        if not untrusted.is_name(sweep_id):
            raise StoreError(f"{sweep_id!r:.80} is not the id of a sweep")
        file = self.sweeps / f"{sweep_id}.json"
        record = read_json(file, _MAX_RECORD_BYTES)
        if not isinstance(record, dict) or record.get("version") != _RECORD_VERSION:
            raise StoreError(f"{file} is not a sweep record of version {_RECORD_VERSION}")
        command, cells = record.get("command"), record.get("cells")
        if not _is_list(command, str) or not isinstance(cells, list):
            raise StoreError(f"{file}: command or cells is missing or malformed")
        wrong = [number for number, row in enumerate(cells) if not _is_row(row)]
        if wrong:
            raise StoreError(f"{file}: cell {wrong[0] + 1} has a value of a wrong type or form")
        return record

    def verify_sweep(self, sweep_id: str) -> None:
        """Check that a sweep's record is the one that was written, by the hash in it.

        Args:
            sweep_id: The id of the record.

        Raises:
            StoreError: It can't be read, or has changed; the message names the file.
        """
        record = self.sweep_record(sweep_id)
        # Records from before a sweep was recorded at its start have the hash as their id.
        if digest(record["cells"]) != record.get("digest", sweep_id):
            file = self.sweeps / f"{sweep_id}.json"
            raise StoreError(f"{file}: its cells have changed since it was written")


def _asked_for(row: Mapping[str, Any]) -> dict[str, Any]:
    """Return what a row of a record says of a cell before any cell is trained."""
    names = ("scene", "label", "condition", "variant_seed", "seed", "variant_id")
    known = {name: row[name] for name in names if name in row}
    return known | {"planned_id": row.get("planned_id", row.get("cell_id"))}


def _modified_ns(file: ConfinedPath) -> int:
    """Return when a file was changed, or a link; 0 where that can't be told."""
    try:
        return file.lstat().st_mtime_ns
    except OSError:
        return 0


def _is_list(value: object, kind: type) -> bool:
    return isinstance(value, list) and all(isinstance(inner, kind) for inner in value)


def _is_row(row: object) -> bool:
    """Return whether the values that a record has for a cell are of the right types."""
    if not isinstance(row, dict):
        return False
    texts = [row.get(key, "") for key in ("scene", "label", "condition")]
    ids = [row.get(key) for key in ("cell_id", "variant_id", "baseline_id")]
    seeds = [row.get("seed", 0), row.get("variant_seed", 0)]
    error = row.get("error")
    return (
        _is_list([*texts, error or ""], str)
        and all(len(text) <= _MAX_NAME for text in texts)
        and all(one is None or untrusted.is_name(one) for one in ids)
        and all(type(seed) is int and 0 <= seed <= _MAX_SEED for seed in seeds)
    )


def full_id(beginning: str, ids: Sequence[str], kinds: str = "cells") -> str:
    """Return the id that begins with a text.

    Args:
        beginning: The id, or so much of it that it is the only one.
        ids: The ids of all that may be meant.
        kinds: What these are, for messages.

    Raises:
        StoreError: No id begins with it, or several do.
    """
    found = [cell_id for cell_id in ids if cell_id.startswith(beginning)]
    if beginning not in found and len(found) != 1:
        some = ", ".join([*found[:_MAX_LISTED], *["..."] * (len(found) > _MAX_LISTED)])
        why = f"several {kinds} have such an id: {some}" if found else f"no {kinds} have such an id"
        raise StoreError(f"{beginning}: {why}; xrgs-store list shows them")
    return beginning if beginning in found else found[0]
