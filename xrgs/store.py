"""What is on disk, and is it done.

A store is a folder: `scenes/`, `variants/`, `cells/<cell id>/`, `locks/`, `sweeps/<sweep id>.json`,
`reports/<sweep id>/`. A cell's `status.json` is written last, by atomic rename, and lists every
other file of the cell: a cell is done when it says so and the files are those that it lists.
"""

from __future__ import annotations

import csv
import json
import os
import shutil
import stat
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from xrgs import progress
from xrgs.errors import XrgsError
from xrgs.files import write_json, write_text
from xrgs.hashing import canonical, digest, file_digest

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    import pandas as pd

    from xrgs.locks import Owner

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


class StoreError(XrgsError):
    """The store's folder can't be used, or does not hold what was asked for."""


def read_json(path: Path) -> Any:
    """The JSON in a file.

    Raises:
        StoreError: the file is missing, unreadable or not JSON; the message names it.
    """
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise StoreError(f"{path}: {error}") from error


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
        if not self.status.exists():
            goes_on = "; it goes on from its checkpoint" if self.checkpoint.exists() else ""
            return State("unfinished", f"it was stopped before it ended{goes_on}")
        try:
            status = read_json(self.status)
            if status["state"] == "failed":
                return State("failed", str(status["reason"]))
            self._check(status, verify=verify)
        except (StoreError, KeyError, TypeError, ValueError, OSError) as error:
            return State("corrupt", str(error))
        return State("done")

    def running(self, owner: Owner | None) -> State:
        """What a cell's state is while somebody holds its lock."""
        now = progress.read(self.progress)
        return State("running", f"by {owner}" + (f": {now}" if now else ""))

    def _check(self, status: Mapping[str, Any], *, verify: bool) -> None:
        if status["state"] != "done":
            raise StoreError(f"status.json: unknown state {status['state']!r}")
        for name, entry in status["files"].items():
            if _size(f"{self.path}/{name}") != entry["bytes"]:
                raise StoreError(f"{name} is missing or has another size")
            hashed = verify and name in _VERIFIED_BY_HASH
            if hashed and file_digest(self.path / name) != entry["sha256"]:
                raise StoreError(f"{name} has changed since the cell finished")
        if not verify:
            return
        with (self.path / "scores.csv").open(encoding="utf-8", newline="") as stream:
            views = [row["view"] for row in csv.DictReader(stream)]
        if views != status["views"]:
            raise StoreError("scores.csv lacks rows of the views that were to be scored")

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
            if entry.name in _GOES_ON_WITH:
                continue
            if entry.is_dir() and not entry.is_symlink():
                shutil.rmtree(entry)
            else:
                entry.unlink()

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
        return dict(read_json(self.path / "identity.json"))

    def summary(self) -> dict[str, Any]:
        """The efficiency figures of the whole cell."""
        return dict(read_json(self.path / "summary.json"))

    def provenance(self) -> dict[str, Any]:
        """Where, when and with what the cell was run."""
        return dict(read_json(self.path / "provenance.json"))

    def history(self) -> pd.DataFrame:
        """One row a logged step."""
        import pandas as pd

        return pd.read_csv(self.path / "history.csv")


def _size(file: str) -> int:
    """Bytes of a regular file, -1 of anything else. A text, for a store asks it of thousands."""
    try:
        found = os.stat(file)  # noqa: PTH116
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
        """Make the folders.

        Raises:
            StoreError: the folder can't be written; the message names it and the `store` key.
        """
        try:
            folders = (self.scenes, self.variants, self.cells, self.locks, self.path / "sweeps")
            for folder in folders:
                folder.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryFile(dir=self.path):
                pass
        except OSError as error:
            raise StoreError(
                f"store={self.path} can't be written ({error}): name another with store=..."
            ) from error

    def cell(self, cell_id: str) -> CellFolder:
        """The folder of a cell, which need not exist."""
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
        file = self.path / "sweeps" / f"{sweep_id or self.latest_sweep()}.json"
        record = read_json(file)
        if not isinstance(record, dict) or record.get("version") != _RECORD_VERSION:
            raise StoreError(f"{file}: not a sweep record of version {_RECORD_VERSION}")
        return record
