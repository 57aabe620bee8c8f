"""The one table of a store: a typed row for each cell and each recorded sweep.

`Store.cells`, `xrgs-status`, `xrgs-store` and `xrgs-report list` show views of these rows.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from types import MappingProxyType

from xrgs.errors import StoreError, XrgsError
from xrgs.runtime.text import listed
from xrgs.safeio.files import file_bytes
from xrgs.splat.backend import arithmetic
from xrgs.store.cell_folder import CellFolder, CellState
from xrgs.store.identity import changed_code
from xrgs.store.schema import Identity, RecordedCell, SweepRecord

#: The states that a cell of a store can have.
STATES = ("done", "running", "planned", "unfinished", "failed", "corrupt")
#: The most ids that a message lists.
_MAX_LISTED = 6


@dataclass(frozen=True, eq=False)
class CellRow:
    """One cell of a store."""

    folder: CellFolder
    state: CellState
    recorded: RecordedCell | None
    """The cell in the record of the latest sweep that has it."""
    sweeps: tuple[str, ...]
    """Ids of the sweeps that have the cell, oldest first."""
    identity: Identity | None
    """None where the file can't be read."""

    @property
    def id(self) -> str:
        """The cell's id."""
        return self.folder.id

    @cached_property
    def scene(self) -> str:
        """The scene as the latest sweep names it; without a sweep, as the cell's config does."""
        if self.recorded is not None:
            return self.recorded.scene
        try:
            scene = self.folder.config().scene
        except XrgsError:
            return "?"
        return scene.name or scene.path or scene.kind

    @property
    def label(self) -> str:
        """The label in the latest sweep, or `?`."""
        return self.recorded.label if self.recorded else "?"

    @property
    def arm(self) -> str:
        """Label and condition."""
        return f"{self.label} {self.recorded.condition if self.recorded else ''}".rstrip()

    @property
    def name(self) -> str:
        """The cell's id, and its name for people: scene, label and condition, and replicate."""
        draw = self.recorded.variant_seed if self.recorded else 0
        parts = (
            self.scene,
            self.arm,
            f"variant.seed {draw}" if draw else "",
            "" if self.seed is None else f"seed {self.seed}",
        )
        return f"{self.id}  {' / '.join(filter(None, parts))}"

    @property
    def seed(self) -> int | None:
        """The seed; None where the identity can't be read."""
        return self.identity.seed if self.identity else None

    @property
    def variant_id(self) -> str | None:
        """The id of the cell's variant; None where the identity can't be read."""
        return self.identity.variant if self.identity else None

    @property
    def stale(self) -> tuple[str, ...]:
        """Parts of the program, and the arithmetic, that differ from the cell's identity.

        A sweep trains a stale cell again, under another id. For a cell `of_elsewhere` it is the
        reason.
        """
        return self._compared[0]

    @property
    def of_elsewhere(self) -> bool:
        """Whether its backend or a component is not installed here, as for reading a store."""
        return self._compared[1]

    @cached_property
    def _compared(self) -> tuple[tuple[str, ...], bool]:
        """`stale` and `of_elsewhere`."""
        if self.identity is None:
            return (), False
        try:
            changed = changed_code(self.identity, cached=True)
            here = arithmetic(str(self.identity.splat["backend"]))
        except XrgsError as error:
            return (str(error),), True
        if self.identity.arithmetic != here:
            changed.append(f"arithmetic ({self.identity.arithmetic}, here {here})")
        return tuple(changed), False

    @cached_property
    def age_s(self) -> float | None:
        """Seconds since the cell ended, or since its folder changed; None if unknown."""
        when = modified(self.folder.status_file) or modified(self.folder.path)
        return when and max(0.0, time.time() - when)

    @cached_property
    def bytes(self) -> int | None:
        """The size of the cell's files; None where the folder can't be read."""
        return size_of(self.folder.path)


def latest_records(records: Mapping[str, SweepRecord]) -> dict[str, RecordedCell]:
    """Return the row of the latest sweep that has each recorded cell, by the cell's id."""
    rows = (row for record in records.values() for row in record.cells)
    return {row.cell_id: row for row in rows if row.cell_id is not None}


@dataclass(frozen=True)
class SweepRow:
    """One recorded sweep of a store."""

    id: str
    record: SweepRecord
    recorded_at: float | None
    """When the record was written, in seconds since the epoch; None if unknown."""
    states: Counter[str]
    """The number of cells in each state; `pending` ones have not begun or not ended."""


def modified(file: Path) -> float | None:
    """Return when a file was changed, in seconds since the epoch; None where it can't be read."""
    try:
        return file.stat().st_mtime_ns / 1e9
    except OSError:
        return None


def size_of(path: Path) -> int | None:
    """Return the bytes of a file, or of all files of a folder; None where it can't be read."""
    try:
        return file_bytes(path)
    except OSError:
        return None


def full_id(
    word: str,
    ids: Iterable[str],
    kinds: str = "cells",
    done: Mapping[str, str] = MappingProxyType({}),
) -> str:
    """Return the id that a word names: an id, a beginning that no other id has, or a scene.

    A scene must have one cell in `done`, which has the labels of its done cells by their ids.
    Messages call the things with these ids `kinds`.

    Raises:
        StoreError: The word names none, or several.
    """
    ids = [*ids]
    if word in ids:
        return word
    matches = {full: "" for full in ids if full.startswith(word)}
    matches |= {full: f" ({label})" for full, label in done.items()}
    if len(matches) == 1:
        return next(iter(matches))
    some = listed([f"{full}{label}" for full, label in matches.items()], _MAX_LISTED)
    of_sweeps = kinds == "sweeps"
    lists = "xrgs-report list has all" if of_sweeps else "xrgs-status lists the done ones"
    of_scene = "none has" if of_sweeps else "no done cell is of"
    why = f"no {kinds} have such an id, and {of_scene} a scene with this name"
    if matches:
        why = f"several {kinds} have such an id or scene: {some}"
    raise StoreError(f"{word}: {why}; {lists}")
