"""Lists what a store holds: its cells with state, age and size, and its sweeps."""

from __future__ import annotations

import time
from collections import Counter
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

from xrgs.errors import StoreError, XrgsError
from xrgs.experiment.identity import changed_code
from xrgs.experiment.store import Store, full_id
from xrgs.runtime import lease
from xrgs.runtime.progress import log_line
from xrgs.runtime.text_table import TextTable, to_text
from xrgs.safeio.files import file_bytes
from xrgs.safeio.sanitize import counted
from xrgs.splat.backend import arithmetic

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from xrgs.experiment.cell_folder import CellFolder, CellState
    from xrgs.experiment.schema import Identity, RecordedCell, SweepRecord

#: The states that a cell of a store can have.
STATES = ("done", "running", "planned", "unfinished", "failed", "corrupt", "unknown")
#: The most names of scenes or labels that a line lists.
_MAX_LISTED = 6


@dataclass(frozen=True)
class CellNames:
    """How recorded sweeps name a cell: the latest one's scene, label and condition."""

    scene: str = "?"
    label: str = "?"
    condition: str = ""
    sweeps: tuple[str, ...] = ()
    """Ids of the sweeps that have the cell, oldest first."""
    baseline_id: str | None = None


@dataclass(frozen=True)
class CellSummary:
    """The state of one cell's folder."""

    folder: CellFolder
    names: CellNames
    """Where no sweep has the cell, its scene is that of its config and its label `?`."""
    variant_id: str | None
    """The id of its variant; None where its identity can't be read."""
    seed: int | None
    state: CellState
    stale: tuple[str, ...]
    """Parts of the program, and the arithmetic, that differ from those of its identity: a sweep
    trains such a cell again."""

    @property
    def id(self) -> str:
        """The cell's id."""
        return self.folder.id

    @property
    def arm(self) -> str:
        """Its label and condition."""
        return f"{self.names.label} {self.names.condition}".rstrip()

    @property
    def name(self) -> str:
        """Its name for people."""
        return f"{self.id}  {self.names.scene} / {self.arm}"

    def age_s(self) -> float | None:
        """Return the seconds since it ended, or since its folder changed; None if unknown."""
        for file in (self.folder.status_file, self.folder.path):
            try:
                return max(0.0, time.time() - file.lstat().st_mtime)
            except OSError:
                continue
        return None

    def bytes(self) -> int | None:
        """Return the bytes of its files; None where that can't be told."""
        return size_of(self.folder.path)


def recorded_names(records: Mapping[str, SweepRecord]) -> dict[str, CellNames]:
    """Return how the records of sweeps name each cell, by the cell's id.

    Args:
        records: What `Store.records` returns: the latest record last.
    """
    names: dict[str, CellNames] = {}
    for sweep_id, record in records.items():
        for row in record.cells:
            if row.cell_id is None:
                continue
            before = names.get(row.cell_id, CellNames()).sweeps
            sweeps = tuple(dict.fromkeys([*before, sweep_id]))
            names[row.cell_id] = CellNames(
                row.scene, row.label, row.condition, sweeps, row.baseline_id
            )
    return names


def summarise(
    cell: CellFolder,
    names: Mapping[str, CellNames],
    holders: Mapping[str, str],
    *,
    verify: bool = False,
) -> CellSummary:
    """Return what is known of a cell's folder.

    Args:
        cell: The cell.
        names: What `recorded_names` returns.
        holders: Descriptions of the processes that train cells now, by the cells' ids.
        verify: Hash the files that reports are made from; otherwise only sizes are compared.
    """
    state = cell.state(verify=verify)
    if state.name not in {"done", "unknown"} and cell.id in holders:
        state = cell.running(holders[cell.id])
    try:
        identity = cell.identity()
    except StoreError:
        identity = None
    return CellSummary(
        cell,
        names.get(cell.id) or CellNames(_scene(cell)),
        identity.variant if identity else None,
        identity.seed if identity else None,
        state,
        _other_code(identity) if identity else (),
    )


def summaries(store: Store) -> list[CellSummary]:
    """Return what is known of all cells of a store, by scene, label, condition, seed and id.

    Args:
        store: The store.

    Raises:
        StoreError: There is no such store, or its cells can't be listed. A sweep's record that
            can't be read is named on stderr.
    """
    if not store.exists:
        raise StoreError(f"store={store.path} is not a store; xrgs-sweep makes one")
    records, damaged = store.records()
    for message in damaged:
        log_line(f"{message}; its names of cells are left out")
    names, holders = recorded_names(records), lease.holders(store.leases)
    cells = [summarise(cell, names, holders) for cell in store.cell_folders()]
    return sorted(cells, key=lambda c: (c.names.scene, c.arm, c.seed or 0, c.id))


def _scene(cell: CellFolder) -> str:
    """Return the scene of a cell that no sweep has recorded."""
    try:
        scene = cell.config().scene
    except XrgsError:
        return "?"
    return scene.name or scene.path or scene.kind


def _other_code(identity: Identity) -> tuple[str, ...]:
    """Return what of the installed program differs from an identity's: parts, and arithmetic.

    A machine on which the backend is not available, where stores are only read, has no arithmetic.
    """
    try:
        changed = changed_code(identity)
        here = arithmetic(str(identity.splat["backend"]))
    except XrgsError as error:
        return (str(error),)
    other = (
        [] if identity.arithmetic == here else [f"arithmetic ({identity.arithmetic}, here {here})"]
    )
    return (*changed, *other)


@dataclass(frozen=True)
class Selection:
    """Which cells of a store are meant; what is empty or 0 restricts nothing."""

    ids: tuple[str, ...] = ()
    """Ids, or their beginnings."""
    scenes: tuple[str, ...] = ()
    ablations: tuple[str, ...] = ()
    states: tuple[str, ...] = ()
    sweeps: tuple[str, ...] = ()
    """Ids of sweeps, one of which must have the cell."""
    older_days: float = 0.0
    larger_mb: float = 0.0

    @property
    def restricts(self) -> bool:
        """Whether anything is asked for."""
        return self != Selection()

    def of(self, cells: Sequence[CellSummary]) -> list[CellSummary]:
        """Return the cells that are meant.

        Args:
            cells: All cells.

        Raises:
            XrgsError: A name is that of no cell, or the beginning of an id is that of several.
        """
        wanted = {one_cell(beginning, cells).id for beginning in self.ids}
        self._check("scenes", self.scenes, [cell.names.scene for cell in cells])
        self._check("ablations", self.ablations, [cell.names.label for cell in cells])
        self._check("states", self.states, STATES)
        self._check("sweep", self.sweeps, [name for cell in cells for name in cell.names.sweeps])
        return [
            cell
            for cell in cells
            if (not wanted or cell.id in wanted)
            and (not self.scenes or cell.names.scene in self.scenes)
            and (not self.ablations or cell.names.label in self.ablations)
            and (not self.states or cell.state.name in self.states)
            and (not self.sweeps or not {*self.sweeps}.isdisjoint(cell.names.sweeps))
            and (not self.older_days or (cell.age_s() or 0.0) >= 86400 * self.older_days)
            and (not self.larger_mb or (cell.bytes() or 0) >= 1e6 * self.larger_mb)
        ]

    @staticmethod
    def _check(key: str, wanted: Sequence[str], known: Sequence[str]) -> None:
        for name in wanted:
            if name not in known:
                choices = ", ".join(dict.fromkeys(known)) or "none"
                raise XrgsError(f"{key}={name}: no cell has that; choose from: {choices}")


def one_cell(beginning: str, cells: Sequence[CellSummary]) -> CellSummary:
    """Return the cell whose id begins with a text.

    Args:
        beginning: The id, or so much of it that it is that of one cell.
        cells: All cells.

    Raises:
        StoreError: No id begins with it, or several do.
    """
    by_id = {cell.id: cell for cell in cells}
    return by_id[full_id(beginning, [*by_id])]


def size_of(path: Path) -> int | None:
    """Return `file_bytes`, or None where that can't be told.

    Args:
        path: A file or a folder.
    """
    try:
        return file_bytes(path)
    except OSError:
        return None


def size_text(count: int | None) -> str:
    """Return a number of bytes for people: `12 MB`, or `unknown`.

    Args:
        count: The bytes; None where they are not known.
    """
    if count is None:
        return "unknown"
    size = float(count)
    for unit in ("B", "kB", "MB"):
        if size < 999.5:
            return f"{size:.0f} {unit}"
        size /= 1000
    return f"{size:.1f} GB"


def age_text(seconds: float | None) -> str:
    """Return an age for people: `40 s`, `12 min`, `3 h`, `5 d`, or `?`.

    Args:
        seconds: The age; None where it is not known.
    """
    if seconds is None:
        return "?"
    for unit, length in (("d", 86400.0), ("h", 3600.0), ("min", 60.0)):
        if seconds >= length:
            return f"{seconds / length:.0f} {unit}"
    return f"{seconds:.0f} s"


def list_cells(cells: Sequence[CellSummary], sort: str) -> str:
    """Return the cells as a table for a terminal.

    Args:
        cells: The cells.
        sort: `name`, `age` (the oldest last) or `size` (the largest last).

    Raises:
        XrgsError: It is none of these.
    """
    if sort not in {"name", "age", "size"}:
        raise XrgsError(f"sort={sort}: choose name, age or size")
    sized = [(cell, cell.age_s(), cell.bytes()) for cell in cells]
    if sort != "name":
        sized.sort(key=lambda row: (row[1] if sort == "age" else row[2]) or 0)
    rows = [
        (
            *(cell.id, cell.names.scene, cell.arm, str(cell.seed), _state(cell)),
            *(age_text(age), size_text(size)),
        )
        for cell, age, size in sized
    ]
    total = size_text(sum(size or 0 for _, _, size in sized))
    return to_text(
        TextTable(
            f"{counted(len(rows), 'cell')}, {total}",
            ("cell", "scene", "ablation", "seed", "state", "age", "size"),
            tuple(rows),
            "lllrlrr",
        )
    ).rstrip()


def _state(cell: CellSummary) -> str:
    """Return a cell's state in a word, with what else one wants to know at a glance."""
    marks = ["trimmed"] if cell.folder.is_trimmed() else []
    marks += ["old code"] if cell.stale else []
    return cell.state.name + (f" ({', '.join(marks)})" if marks else "")


def list_sweeps(path: Path) -> str:
    """Return the sweeps of a store as a table for a terminal, the latest last.

    Args:
        path: The store's folder.

    Raises:
        StoreError: There is no such store, or its sweeps can't be listed. A record that can't be
            read is named on stderr.
    """
    store = Store(path)
    if not store.exists:
        raise StoreError(f"store={path} is not a store; xrgs-sweep makes one")
    records, damaged = store.records()
    for message in damaged:
        log_line(message)
    states = _states(store, records)
    rows = [
        (
            sweep_id,
            _date(store.sweeps / f"{sweep_id}.json"),
            _distinct(row.scene for row in record.cells),
            _distinct(row.label for row in record.cells),
            _counts(record.cells, states),
        )
        for sweep_id, record in records.items()
    ]
    columns = ("sweep", "recorded", "scenes", "labels", "cells")
    return to_text(TextTable(f"{len(rows)} sweeps", columns, tuple(rows), "lllll")).rstrip()


def _states(store: Store, records: Mapping[str, SweepRecord]) -> dict[str, str]:
    """Return the state of every recorded cell by its id."""
    holders = lease.holders(store.leases)
    ids = {row.cell_id for record in records.values() for row in record.cells}
    states = {}
    for cell_id in filter(None, ids):
        state = store.cell(cell_id).state(verify=False).name
        states[cell_id] = "running" if state == "unfinished" and cell_id in holders else state
    return states


def _counts(rows: Sequence[RecordedCell], states: Mapping[str, str]) -> str:
    """Return how many cells of a sweep have which state: `3 of 12 done, 1 running, 8 pending`."""
    names = Counter(
        "failed" if row.error else states.get(row.cell_id or "", "absent") for row in rows
    )
    done = f"{names.pop('done', 0)} of {len(rows)} done"
    names["pending"] = sum(names.pop(name, 0) for name in ("absent", "planned", "unfinished"))
    return ", ".join([done, *(f"{count} {name}" for name, count in names.items() if count)])


def _distinct(names: Any) -> str:
    """Return the different names, the first six of them."""
    distinct = list(dict.fromkeys(names))
    more = len(distinct) - _MAX_LISTED
    return ", ".join(distinct[:_MAX_LISTED]) + (f" and {more} more" if more > 0 else "")


def _date(file: Path) -> str:
    """Return when a file was written, local time; `?` where that can't be told."""
    try:
        written = datetime.fromtimestamp(file.lstat().st_mtime, UTC).astimezone()
    except (OSError, ValueError, OverflowError):
        return "?"
    return written.strftime("%Y-%m-%d %H:%M")
