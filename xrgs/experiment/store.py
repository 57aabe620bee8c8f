"""What is on disk, and is it done.

A store is a folder: `scenes/`, `variants/`, `cells/<cell id>/`, `locks/`, `sweeps/<sweep id>.json`,
`reports/<sweep id>/`. A cell's `status.json` is written last, by atomic rename, and lists every
other file of the cell: a cell is done when it says so and the files are those that it lists.
"""

from __future__ import annotations

import io
import os
import stat
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from xrgs.runtime import progress
from xrgs.safeio import untrusted
from xrgs.safeio.atomic import write_json, write_text
from xrgs.safeio.hashing import canonical, digest, file_digest
from xrgs.safeio.records import StoreError, as_number, read_json, read_object, read_table

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    import pandas as pd


#: A report rests on these, so they are verified byte for byte; the others by their size.
_VERIFIED_BY_HASH = frozenset(
    {"config.json", "identity.json", "scores.csv", "summary.json", "history.csv"}
)
_CHECKPOINT = "checkpoint.npz"
_PROGRESS = "progress.json"
_NOT_RESULTS = frozenset(
    {"log.txt", "status.json", _PROGRESS, _CHECKPOINT, f"refused-{_CHECKPOINT}"}
)
#: What a cell that goes on from its checkpoint keeps of the try that was stopped.
_GOES_ON_WITH = frozenset({_CHECKPOINT, "identity.json", "log.txt"})
_RECORD_VERSION = 1
#: Bytes without which a disk is full: less than the files of any cell.
_ROOM = 1 << 15
_MOST_SEED = (1 << 63) - 1


@dataclass(frozen=True)
class State:
    """Where a cell stands: `absent`, `unfinished`, `failed`, `corrupt` or `done`, and why."""

    name: str
    reason: str = ""


@dataclass(frozen=True)
class CellFolder:
    """One cell's folder in the store."""

    path: Path

    @property
    def id(self) -> str:
        """The cell's id."""
        return self.path.name

    @property
    def checkpoint(self) -> Path:
        """State of the training, while it is not done."""
        return self.path / _CHECKPOINT

    @property
    def progress(self) -> Path:
        """How far it is, while its process runs; a killed one leaves it behind."""
        return self.path / _PROGRESS

    @property
    def status(self) -> Path:
        """Written last: what it says is the end."""
        return self.path / "status.json"

    def state(self, *, verify: bool = True) -> State:
        """Whether this cell's result is there and can be trusted.

        Args:
            verify: hash what reports rest on too; else sizes alone are compared.
        """
        if not self.path.is_dir():
            return State("absent")
        if self.path.is_symlink():
            return State("corrupt", "it is a link: a cell is a folder of its own")
        if not self.status.exists():
            goes_on = "; it goes on from its checkpoint" if self.checkpoint.exists() else ""
            return State("unfinished", f"it was stopped before it ended{goes_on}")
        try:
            status = read_json(self.status)
            if status["state"] == "failed":
                return State("failed", str(status["reason"]))
            self._check(status, verify=verify)
        except (StoreError, AttributeError, KeyError, TypeError, ValueError, OSError) as error:
            return State("corrupt", str(error))
        return State("done")

    def running(self, owner: object) -> State:
        """What a cell's state is while somebody holds its lock."""
        now = progress.read(self.progress)
        return State("running", f"by {owner}" + (f": {now}" if now else ""))

    def _check(self, status: Mapping[str, Any], *, verify: bool) -> None:
        if status["state"] != "done":
            raise StoreError(f"status.json: unknown state {status['state']!r}")
        for name, entry in status["files"].items():
            if not untrusted.is_inside(name):
                raise StoreError(f"status.json: {name!r:.80} is no file of this cell")
            if _size(f"{self.path}/{name}") != entry["bytes"]:
                raise StoreError(f"{name} is missing or has another size")
            hashed = verify and name in _VERIFIED_BY_HASH
            if hashed and file_digest(self.path / name) != entry["sha256"]:
                raise StoreError(f"{name} has changed since the cell finished")
        if verify and [view for view, _ in self.scores()] != status["views"]:
            raise StoreError("scores.csv lacks rows of the views that were to be scored")

    def scores(self) -> list[tuple[str, dict[str, float]]]:
        """Every test view's name and scores, NaN where there is none.

        Raises:
            StoreError: they are not there, or are no such table.
        """
        file = self.path / "scores.csv"
        header, rows = read_table(file)
        views = [row[0] for row in rows]
        if header[:1] != ["view"] or not all(map(untrusted.is_name, views)):
            raise StoreError(f"{file}: the names of the views can't be")
        try:
            values = [map(as_number, row[1:]) for row in rows]
            found = [dict(zip(header[1:], row, strict=True)) for row in values]
        except ValueError as error:
            raise StoreError(f"{file}: {error}") from error
        return list(zip(views, found, strict=True))

    def begin(self, config: Mapping[str, Any], identity: Mapping[str, Any]) -> None:
        """A folder with the cell's config, and nothing else that could be taken for a result.

        An earlier try of the very same cell leaves its checkpoint and its log. What can't be that,
        and what failed or is corrupt and has no checkpoint, is set aside to be looked at.
        """
        if self._can_go_on(identity):
            self._clear()
        elif self.path.exists():
            self.path.rename(_free_name(self.path))
        self.path.mkdir(parents=True, exist_ok=True)
        write_json(self.path / "config.json", config)
        write_json(self.path / "identity.json", identity)

    def _can_go_on(self, identity: Mapping[str, Any]) -> bool:
        state = self.state().name
        if state != "unfinished" and not (state == "failed" and self.checkpoint.is_file()):
            return False
        try:
            return canonical(self.identity()) == canonical(identity)
        except (StoreError, TypeError, ValueError):
            # Killed before it had said what it is: nothing in it has begun yet.
            begun = (self.path / "identity.json", self.checkpoint)
            return not any(file.exists() for file in begun)

    def _clear(self) -> None:
        for entry in self.path.iterdir():
            if entry.name not in _GOES_ON_WITH or entry.is_symlink():
                untrusted.remove(entry)

    def finish(self, views: Sequence[str], protocol: int) -> None:
        """Declare the cell done: its files are those that lie here now, without the checkpoint."""
        files = {
            file.relative_to(self.path).as_posix(): {
                "bytes": file.stat().st_size,
                "sha256": file_digest(file),
            }
            for file in sorted(self.path.rglob("*"))
            if file.is_file() and file.name not in _NOT_RESULTS
        }
        self._set_status(
            {
                "state": "done",
                "reason": "",
                "views": list(views),
                "protocol": protocol,
                "files": files,
            }
        )
        self.drop_checkpoint()  # last: until it is done, the cell may need it

    def drop_checkpoint(self) -> None:
        """Remove what a finished cell needs no more, whoever was killed before doing so."""
        self.checkpoint.unlink(missing_ok=True)

    def fail(self, reason: str) -> None:
        """Declare the cell failed; `error.txt` is there even where it died without a word."""
        error = self.path / "error.txt"
        if not error.exists():
            write_text(error, f"{reason}\n")
        self.progress.unlink(missing_ok=True)
        self._set_status({"state": "failed", "reason": reason, "views": [], "files": {}})

    def _set_status(self, status: Mapping[str, Any]) -> None:
        write_json(self.status, status)

    def identity(self) -> dict[str, Any]:
        """What the cell's id is the digest of."""
        return read_object(self.path / "identity.json")

    def summary(self) -> dict[str, Any]:
        """The efficiency figures of the whole cell."""
        return read_object(self.path / "summary.json")

    def provenance(self) -> dict[str, Any]:
        """Where, when and with what the cell was run."""
        return read_object(self.path / "provenance.json")

    def history(self) -> pd.DataFrame:
        """One row a logged step.

        Raises:
            OSError: it can't be read.
            ValueError: it is no table.
        """
        import pandas as pd

        return pd.read_csv(io.BytesIO(untrusted.read_bytes(self.path / "history.csv")))


def _size(file: str) -> int:
    """Bytes of a regular file, -1 of anything else. A text, for a store asks it of thousands."""
    try:
        found = os.lstat(file)
    except OSError:
        return -1
    return found.st_size if stat.S_ISREG(found.st_mode) else -1


def _free_name(path: Path) -> Path:
    """A sibling that does not exist: `<name>.aside-1`, `-2`, ..."""
    number = 1
    while (free := path.with_name(f"{path.name}.aside-{number}")).exists():
        number += 1
    return free


@dataclass(frozen=True)
class Store:
    """Everything that is kept, under one folder."""

    path: Path

    @property
    def scenes(self) -> Path:
        """Embedded scenes, rendered."""
        return self.path / "scenes"

    @property
    def variants(self) -> Path:
        """Frozen variants."""
        return self.path / "variants"

    @property
    def cells(self) -> Path:
        """Results."""
        return self.path / "cells"

    @property
    def locks(self) -> Path:
        """Of the cells that are being trained."""
        return self.path / "locks"

    @property
    def reports(self) -> Path:
        """Tables and figures."""
        return self.path / "reports"

    def prepare(self) -> None:
        """Make the folders, and see that there is room to write.

        Raises:
            StoreError: the folder can't be written; the message names it and the `store` key.
        """
        try:
            folders = (self.scenes, self.variants, self.cells, self.locks, self.path / "sweeps")
            for folder in folders:
                folder.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryFile(dir=self.path) as file:
                file.write(bytes(_ROOM))
        except OSError as error:
            raise StoreError(
                f"store={self.path} can't be written ({error}): name another with store=..."
            ) from error

    def cell(self, cell_id: str) -> CellFolder:
        """The folder of a cell, which need not exist.

        Raises:
            StoreError: that can't be the id of a cell.
        """
        if not untrusted.is_name(cell_id):
            raise StoreError(f"{cell_id!r:.80}: no id of a cell")
        return CellFolder(self.cells / cell_id)

    def write_sweep(self, command: Sequence[str], cells: Iterable[Mapping[str, Any]]) -> str:
        """Keep what a sweep compared, for its report. The same comparison gives the same id."""
        rows = [dict(cell) for cell in cells]
        sweep_id = digest(rows)
        record = {"version": _RECORD_VERSION, "command": list(command), "cells": rows}
        write_json(self.path / "sweeps" / f"{sweep_id}.json", record)
        return sweep_id

    def latest_sweep(self) -> str:
        """The id of the sweep recorded last.

        Raises:
            StoreError: there is none.
        """
        records = list((self.path / "sweeps").glob("*.json"))
        if not records:
            raise StoreError(f"store={self.path} holds no sweep: run xrgs-sweep first")
        return max(records, key=lambda file: (file.stat().st_mtime_ns, file.name)).stem

    def sweep_record(self, sweep_id: str | None = None) -> dict[str, Any]:
        """What a sweep compared; the latest one where no id is given.

        Raises:
            StoreError: there is no such sweep, or its record is of another version.
        """
        sweep_id = sweep_id or self.latest_sweep()
        if not untrusted.is_name(sweep_id):
            raise StoreError(f"{sweep_id!r:.80}: no id of a sweep")
        file = self.path / "sweeps" / f"{sweep_id}.json"
        record = read_json(file)
        if not isinstance(record, dict) or record.get("version") != _RECORD_VERSION:
            raise StoreError(f"{file}: not a sweep record of version {_RECORD_VERSION}")
        command, cells = record.get("command"), record.get("cells")
        if not _is_list(command, str) or not isinstance(cells, list):
            raise StoreError(f"{file}: no command or no cells")
        wrong = [number for number, row in enumerate(cells) if not _is_row(row)]
        if wrong:
            raise StoreError(f"{file}: its cell {wrong[0] + 1} has a value that can't be")
        return record


def _is_list(value: object, kind: type) -> bool:
    return isinstance(value, list) and all(isinstance(inner, kind) for inner in value)


def _is_row(row: object) -> bool:
    """Whether what a sweep's record says of a cell is of the right types, as far as it does."""
    if not isinstance(row, dict):
        return False
    texts = [row.get(key, "") for key in ("scene", "label", "condition")]
    ids = [row.get(key) for key in ("cell_id", "variant_id", "baseline_id")]
    seed, error = row.get("seed", 0), row.get("error")
    return (
        _is_list([*texts, error or ""], str)
        and all(one is None or untrusted.is_name(one) for one in ids)
        and type(seed) is int
        and 0 <= seed <= _MOST_SEED
    )
