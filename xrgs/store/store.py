"""The store: a folder that keeps variants, trained cells, sweep records and reports.

Its subfolders are `scenes/`, `variants/`, `cells/<cell id>/`, `locks/`, `hydra/` (one folder per
call of `xrgs-sweep`), `sweeps/<sweep id>.json` and `reports/<sweep id>/`. The files of a cell are
described in `xrgs.store.cell_folder`.
"""

from __future__ import annotations

import stat
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec

from xrgs.errors import StoreError, UnreadableError
from xrgs.mixture import paths as variant_folders
from xrgs.mixture.saved_variant import MANIFEST
from xrgs.photos.scenes.scene import scene_name
from xrgs.runtime import lease
from xrgs.runtime.progress import log_line
from xrgs.safeio.atomic import write_json
from xrgs.safeio.files import check_writable, is_name, is_transient, sync_name
from xrgs.safeio.hashing import digest
from xrgs.safeio.paths import user_path
from xrgs.safeio.records import list_folder, read_struct
from xrgs.safeio.sanitize import for_line
from xrgs.store import listing
from xrgs.store.cell_folder import IDENTITY, CellFolder, CellState
from xrgs.store.listing import CellRow, SweepRow, modified
from xrgs.store.schema import RecordedCell, SweepRecord

if TYPE_CHECKING:
    import pandas as pd


#: Label of the cells that all others are compared to.
BASELINE = "baseline"
#: The folder of the store where none is named.
DEFAULT_STORE = Path("xrgs-store")

#: The largest record of a sweep that is read, in bytes: 100,000 cells take 30 MB.
_MAX_RECORD_BYTES = 1 << 25
#: Bytes that must be writable before a sweep starts; any cell needs more than that.
_MIN_FREE_BYTES = 1 << 15


class StoreGoneError(StoreError):
    """The store was moved, deleted or unmounted while a sweep used it."""


class Store:
    """A store: everything that sweeps keep, in one folder.

    Examples:
        >>> cells = Store("xrgs-store").cells()
        >>> sorted(cells["label"])
        ['baseline', 'baseline', 'consistency', 'consistency']
        >>> store = Store("xrgs-store")
        >>> file = store.cell(cells["cell_id"][0]).path / "splats.ply"
        >>> gaussians = load_gaussians(file).gaussians
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        """The folder."""
        self.scenes = self.path / "scenes"
        """Folder of the rendered photographs of procedural scenes, and of the frames of videos."""
        self.variants = self.path / "variants"
        """Folder of the frozen variants."""
        self.cells_folder = self.path / "cells"
        """Folder of the cells."""
        self.leases = self.path / "locks"
        """Folder of the leases of cells that are being trained."""
        self.sweeps = self.path / "sweeps"
        """Folder of the records of sweeps."""
        self.reports = self.path / "reports"
        """Folder of the reports: tables and figures."""

    @property
    def exists(self) -> bool:
        """Whether the folder is there and has a folder of cells.

        Raises:
            UnreadableError: The folder can't be read now.
        """
        try:
            return stat.S_ISDIR(self.cells_folder.stat().st_mode)
        except OSError as error:
            if is_transient(error):
                raise UnreadableError(f"store={self.path}: {error.strerror}; try again") from error
            return False

    def check_exists(self) -> None:
        """Raise `StoreError` where the folder is no store, or can't be read now."""
        if not self.exists:
            raise StoreError(f"store={self.path} is not a store; xrgs-sweep makes one")

    @property
    def is_gone(self) -> bool:
        """Whether a store that was prepared is no longer there; False where it can't be read now.

        An empty folder in its place, as an unmounted disk leaves it, is no store.
        """
        try:
            return not self.exists
        except StoreError:
            return False

    def check_not_gone(self) -> None:
        """Raise `StoreGoneError` where the store is gone: nothing may be created in its place."""
        if self.is_gone:
            raise StoreGoneError(
                f"store={self.path}: it is no longer there (moved or deleted?); finished cells are"
                " where the store went: run the same command again with store= naming that folder"
            )

    def prepare(self) -> None:
        """Create the folder and its subfolders, and check that the disk has room.

        StoreError says that the folder can't be written, and names it and the `store` key.
        """
        try:
            self.path.mkdir(parents=True, exist_ok=True)
            for folder in (self.scenes, self.variants, self.cells_folder, self.leases, self.sweeps):
                folder.mkdir(exist_ok=True)
            sync_name(self.cells_folder)  # and the names of the others, which are beside it
        except OSError as error:
            raise self._unwritable(error) from error
        self.check_room()

    def check_room(self) -> None:
        """Check that the disk has room, and leave nothing behind; the folder need not exist yet."""
        try:
            check_writable(self.path, _MIN_FREE_BYTES)
        except OSError as error:
            raise self._unwritable(error) from error

    def _unwritable(self, error: OSError) -> StoreError:
        return StoreError(
            f"store={self.path} can't be written ({error.strerror}: {error.filename}): choose"
            " another with store=..."
        )

    def cell(self, cell_id: str) -> CellFolder:
        """Return the folder of a cell, which need not exist; StoreError if its id is no name."""
        return CellFolder(self.cells_folder / _checked(cell_id, "cell"))

    def variant(self, variant_id: str) -> Path:
        """Return the folder of a variant, which need not exist; see `cell`."""
        return self.variants / _checked(variant_id, "variant")

    def cells(self, *, verify: bool = True) -> pd.DataFrame:
        """List the cells: their names, configs, states and scores.

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
        from xrgs.store.results import cell_columns, cell_metrics, cells_table

        self.check_exists()
        table = []
        for row in self.cell_rows(verify=verify):
            state, metrics = row.state, {}
            if state.name == "done":
                try:
                    metrics = cell_metrics(row.folder.summary(), row.folder.scores())
                except (StoreError, OSError) as error:
                    state = CellState.of_error(error)
            columns: dict[str, Any] = cell_columns(row.folder, row.recorded)
            outcome = {"state": state.name, "reason": for_line(state.reason)}
            table.append(columns | metrics | outcome)
        return cells_table(table)

    def cell_rows(
        self, records: Mapping[str, SweepRecord] | None = None, *, verify: bool = False
    ) -> list[CellRow]:
        """List the cells by scene, label, condition, seed and id, see `cells`.

        The records of sweeps are read where they are not given.
        """
        self.check_exists()
        records = self._records_or_warnings() if records is None else records
        recorded, holders = listing.latest_records(records), lease.holders(self.leases)
        sweeps: dict[str | None, list[str]] = {}
        for sweep_id, record in records.items():
            for cell_id in {row.cell_id for row in record.cells}:
                sweeps.setdefault(cell_id, []).append(sweep_id)
        rows = []
        for cell in self.cell_folders():
            state = cell.state(verify=verify, owner=holders.get(cell.id))
            identity = None
            with suppress(StoreError):
                identity = cell.identity()
            sweep_ids = tuple(sweeps.get(cell.id, ()))
            rows.append(CellRow(cell, state, recorded.get(cell.id), sweep_ids, identity))
        return sorted(rows, key=lambda row: (row.scene, row.arm, row.seed or 0, row.id))

    def sweep_rows(self) -> list[SweepRow]:
        """List the recorded sweeps, the latest last; raises as `cell_rows`."""
        records = self._records_or_warnings()
        not_ended = {"absent", "planned", "unfinished"}
        states: dict[str | None, str] = {
            row.id: row.state.name
            for row in self.cell_rows(records)
            if row.state.name not in not_ended
        }
        rows = []
        for name, record in records.items():
            cells = record.cells
            of = ("failed" if row.error else states.get(row.cell_id, "pending") for row in cells)
            when = modified(self.sweeps / f"{name}.json")
            rows.append(SweepRow(name, record, when, Counter(of)))
        return rows

    def cell_names(self) -> dict[str, RecordedCell]:
        """Return the row of the latest sweep that has each recorded cell, by the cell's id."""
        return listing.latest_records(self._records_or_warnings())

    def sweeps_of(self, *cell_ids: str) -> list[str]:
        """Return the ids of the recorded sweeps that have one of some cells, the latest last."""
        records = self._records_or_warnings()
        return [i for i, r in records.items() if any(row.cell_id in cell_ids for row in r.cells)]

    def _records_or_warnings(self) -> dict[str, SweepRecord]:
        """Return the records that can be read; the others are named on stderr."""
        try:
            records, damaged = self.records()
        except StoreError as error:
            records, damaged = {}, (str(error),)
        for message in damaged:
            log_line(f"{message}; its names of cells are left out")
        return records

    def find_cell(self, word: str) -> CellFolder:
        """Return the cell that a word names.

        Args:
            word: The cell's id, or a beginning that no other id has; the name of a scene with one
                done cell; or the path of a cell's or a scene's folder.

        Raises:
            StoreError: There is no store, the word names no cell, or it names several.
        """
        if (folder := user_path(word) / IDENTITY).is_file():
            return CellFolder(folder.parent.absolute())
        self.check_exists()
        return self.cell(self._full_id(word, [cell.id for cell in self.cell_folders()], "cells"))

    def find_folder(self, word: str) -> Path:
        """Return the folder of the cell or the variant that a word names, see `find_cell`."""
        if any((user_path(word) / name).is_file() for name in (IDENTITY, MANIFEST)):
            return user_path(word)
        self.check_exists()
        variants = filter(variant_folders.is_variant, list_folder(self.variants))
        folders = {name: self.variant(name) for name in variants}
        folders |= {cell.id: cell.path for cell in self.cell_folders()}
        return folders[self._full_id(word, list(folders), "cells or variants")]

    def find_sweep(self, word: str) -> str:
        """Return the id of the sweep that a word names, see `find_cell`.

        A scene names its latest sweep.
        """
        self.check_exists()
        records, name = self._records_or_warnings(), _name_of(word)
        ids = [i for i, r in records.items() if any(row.scene == name for row in r.cells)]
        latest = {ids[-1]: name} if ids else {}
        return listing.full_id(name, self.sweep_ids(), "sweeps", latest)

    def _full_id(self, word: str, ids: Sequence[str], kinds: str) -> str:
        """Return the one id that a word names."""
        name = _name_of(word)
        done = {
            cell_id: row.label
            for cell_id, row in self.cell_names().items()
            if row.scene == name and self.cell(cell_id).state(verify=False).name == "done"
        }
        return listing.full_id(name, ids, kinds, done)

    def cell_folders(self) -> list[CellFolder]:
        """Return the cells, sorted by id, without folders of earlier attempts (`<id>.aside-1`).

        A link or a file with the name of a cell is among them; its state says that it is corrupt.
        """
        names = list_folder(self.cells_folder)
        return [self.cell(name) for name in names if "." not in name and is_name(name)]

    def sweep_ids(self) -> list[str]:
        """Return the ids of the recorded sweeps, oldest first."""
        names = [name for name in list_folder(self.sweeps) if name.endswith(".json")]
        files = [self.sweeps / name for name in names if is_name(name)]
        return [file.stem for file in sorted(files, key=lambda file: (modified(file) or 0, file))]

    def records(self) -> tuple[dict[str, SweepRecord], tuple[str, ...]]:
        """Read the records of all sweeps, oldest first, by their ids.

        For each one that can't be read there is a message that names its file.
        """
        records, damaged = {}, []
        for sweep_id in self.sweep_ids():
            try:
                records[sweep_id] = self.sweep_record(sweep_id)
            except StoreError as error:
                damaged.append(str(error))
        return records, tuple(damaged)

    def write_sweep(
        self, command: Sequence[str], cells: Sequence[RecordedCell], sweep_id: str | None = None
    ) -> str:
        """Record which cells a sweep compares, for its report: when it starts, and at its end.

        The id of the record is returned, and given again at the end. Sweeps that ask for the same
        cells have the same id, however many of the cells are done.
        """
        rows = msgspec.to_builtins(tuple(cells))
        record = SweepRecord(1, tuple(command), tuple(cells), digest(rows))
        if sweep_id is None:  # of what is known before any cell is trained
            names = ("scene", "label", "condition", "variant_seed", "seed", "variant_id")
            sweep_id = digest([{n: row[n] for n in (*names, "planned_id")} for row in rows])
        write_json(self.sweeps / f"{sweep_id}.json", msgspec.to_builtins(record))
        return sweep_id

    def latest_sweep(self) -> str:
        """Return the id of the sweep that was recorded last, of those that can be read.

        A newer record that can't be read is named on stderr.

        Raises:
            StoreError: There is no store, or it has no record of a sweep, or none that can be read.
        """
        self.check_exists()
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

    def sweep_record(self, sweep_id: str | None = None) -> SweepRecord:
        """Return the record of a sweep; None for the latest."""
        name = _checked(sweep_id or self.latest_sweep(), "sweep")
        return read_struct(self.sweeps / f"{name}.json", SweepRecord, _MAX_RECORD_BYTES)


def unchanged_record(file: Path) -> SweepRecord:
    """Read the record of a sweep, and check by the hash in it that nobody has changed it."""
    record = read_struct(file, SweepRecord, _MAX_RECORD_BYTES)
    if digest(msgspec.to_builtins(record.cells)) != record.digest:
        raise StoreError(f"{file}: its cells have changed since it was written")
    return record


def _checked(name: str, kind: str) -> str:
    """Return an id, which must be a name."""
    if not is_name(name):
        raise StoreError(f"{name!r:.80} is not the id of a {kind}")
    return name


def _name_of(word: str) -> str:
    """Return a word; where it is a folder, the name of the scene in the folder."""
    return scene_name(user_path(word)) if user_path(word).is_dir() else word
