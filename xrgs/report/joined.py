"""Reads several stores and several sweeps as one, and chooses rows of them, for one report.

A study may be trained in parts: scene by scene, on two machines, each into a store of its own. Its
report needs the rows of all records, and finds each cell in the store where it is done.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import msgspec

from xrgs.errors import StoreError
from xrgs.experiment.store import BASELINE
from xrgs.report.collect import ReportError
from xrgs.safeio.sanitize import for_file_name

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence

    from xrgs.experiment.cell_folder import CellFolder
    from xrgs.experiment.schema import SweepRecord
    from xrgs.experiment.store import Store

_T = TypeVar("_T")
#: What tells one cell of a study from another.
_CELL = ("scene", "condition", "label", "variant_seed", "seed")
#: The most ids that the name of a report lists.
_MAX_LISTED = 4


@dataclass(frozen=True)
class Choice:
    """Which rows of a sweep a report has."""

    scenes: tuple[str, ...] = ()
    """Names of scenes; empty for all."""
    ablations: tuple[str, ...] = ()
    """Labels of ablations and controls, beside what they are compared with; empty for all."""

    def rows(self, rows: Sequence[dict[str, Any]], against: str) -> list[dict[str, Any]]:
        """Return the chosen rows of a record.

        Args:
            rows: The rows.
            against: The label that all others are compared with; its rows and the baseline's stay.

        Raises:
            ReportError: No row has a scene or a label that is named; the message lists those that
                there are.
        """
        for key, name, wanted in (
            ("scenes", "scene", self.scenes),
            ("ablations", "label", self.ablations),
        ):
            known = list(dict.fromkeys(str(row.get(name)) for row in rows))
            for value in wanted:
                if value not in known:
                    raise ReportError(
                        f"{key}={value}: the sweep has none of that name; choose from:"
                        f" {', '.join(known)}"
                    )
        labels = {*self.ablations, against, BASELINE} if self.ablations else None
        return [
            row
            for row in rows
            if (not self.scenes or row.get("scene") in self.scenes)
            and (labels is None or row.get("label") in labels)
        ]

    @property
    def suffix(self) -> str:
        """What the name of the report's folder says of the choice; empty where it is everything."""
        parts = (("scenes", self.scenes), ("ablations", self.ablations))
        return "".join(f".{key}-{for_file_name(','.join(names))}" for key, names in parts if names)


@dataclass(frozen=True)
class JoinedStore:
    """One or several stores from which a report is made; nothing is written through it."""

    stores: tuple[Store, ...]
    """The stores; of a cell that several have done, the first counts."""
    external: Mapping[str, Path] = field(default_factory=dict)
    """Folders of renders that another program made, `Sweep.renders`."""

    def cell(self, cell_id: str) -> CellFolder:
        """Return the folder of a cell, in the store where it is done if there is one.

        Args:
            cell_id: The cell's id.

        Raises:
            StoreError: The id is not a valid name of a folder.
        """
        return _first([store.cell(cell_id) for store in self.stores], _is_done, _is_there)

    def variant(self, variant_id: str) -> Path:
        """Return the folder of a variant, in a store that has it if there is one.

        Args:
            variant_id: The variant's id.

        Raises:
            StoreError: The id is not a valid name of a folder.
        """
        folders = [store.variant(variant_id) for store in self.stores]
        return _first(folders, Path.is_dir)

    def render(self, cell_id: str, view: str) -> Path:
        """Return the file of the render of a view, which need not exist.

        Args:
            cell_id: The id of a cell, or of a row of another program's renders.
            view: The name of the view.

        Raises:
            StoreError: The cell's renders were removed on purpose, or its id is not a valid name.
        """
        if cell_id in self.external:
            return self.external[cell_id] / f"{view}.png"
        cell, name = self.cell(cell_id), f"renders/{view}.png"
        cell.check_not_trimmed(name)
        return cell.path / name

    def latest_sweeps(self) -> tuple[str, ...]:
        """Return the id of each store's latest sweep, without repetitions.

        Raises:
            StoreError: A store has no record of a sweep, or none that can be read.
        """
        return tuple(dict.fromkeys(store.latest_sweep() for store in self.stores))

    def sweep_record(self, sweep_ids: Sequence[str]) -> dict[str, Any]:
        """Join the records of sweeps.

        Args:
            sweep_ids: Their ids; each is a sweep of one of the stores, or of several.

        Returns:
            `commands` (the arguments of `xrgs-sweep` of each record, by the sweep's id) and `cells`
            (the rows, without repetitions).

        Raises:
            StoreError: No store has such a sweep, or its record is malformed.
            ReportError: Two records have different cells for one scene, condition, label and
                replicate; the message names both.
        """
        commands: dict[str, tuple[str, ...]] = {}
        rows: dict[tuple[Any, ...], tuple[str, dict[str, Any]]] = {}
        for sweep_id in sweep_ids:
            for record in self._records(sweep_id):
                commands[sweep_id] = record.command
                for row in msgspec.to_builtins(record.cells):
                    key = tuple(row.get(name, 0) for name in _CELL)
                    rows[key] = sweep_id, _same(rows.get(key), sweep_id, row)
        return {"commands": commands, "cells": [row for _, row in rows.values()]}

    def _records(self, sweep_id: str) -> Iterable[SweepRecord]:
        having = [store for store in self.stores if sweep_id in store.sweep_ids()]
        if not having and len(self.stores) > 1:
            paths = ", ".join(str(store.path) for store in self.stores)
            raise StoreError(f"sweep={sweep_id}: there is no such sweep in {paths}")
        return [store.sweep_record(sweep_id) for store in having or self.stores]


def _first(found: Sequence[_T], *wanted: Callable[[_T], bool]) -> _T:
    """Return the first that satisfies the first condition, else the next one; else the first.

    Of one alone nothing is asked.
    """
    conditions = wanted if len(found) > 1 else ()
    fitting = (one for condition in conditions for one in found if condition(one))
    return next(fitting, found[0])


def _is_done(cell: CellFolder) -> bool:
    return cell.state(verify=False).name == "done"


def _is_there(cell: CellFolder) -> bool:
    return cell.path.is_dir()


def _same(
    known: tuple[str, dict[str, Any]] | None, sweep_id: str, row: dict[str, Any]
) -> dict[str, Any]:
    """Return the row that says more of two for the same cell; refuse two different cells."""
    if known is None or known[1].get("cell_id") is None:
        return row
    before, first = known
    if row.get("cell_id") in {None, first["cell_id"]}:
        return first
    name = " / ".join(str(row[key]) for key in ("scene", "label", "condition") if row.get(key))
    raise ReportError(
        f"{name} / seed {row.get('seed')} is cell {first['cell_id']} in sweep {before} and"
        f" {row['cell_id']} in sweep {sweep_id}: they differ in configuration, code or variant."
        " Leave one of the sweeps out, or choose others with scenes= and ablations="
    )


def report_name(sweep_ids: Sequence[str]) -> str:
    """Return the name of the folder for the report of sweeps: their ids, joined by `+`.

    Args:
        sweep_ids: The ids.
    """
    more = len(sweep_ids) - _MAX_LISTED
    listed = "+".join(sweep_ids[:_MAX_LISTED])
    return f"{listed}+{for_file_name(' '.join(sweep_ids[_MAX_LISTED:]))}" if more > 0 else listed
