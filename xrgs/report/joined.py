"""Joins the records of several sweeps of a store, and chooses rows of them, for one report.

A study may be trained in parts, for example scene by scene. Its report needs the rows of all
records. A store from another machine comes in through `xrgs-store import`.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from xrgs.mixture.paths import trimmed_folder
from xrgs.report.collect import ReportError
from xrgs.safeio.sanitize import for_file_name
from xrgs.store.inspect import read_report
from xrgs.store.store import BASELINE

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from xrgs.store.cell_folder import CellFolder
    from xrgs.store.inspect import SfmReport
    from xrgs.store.schema import RecordedCell
    from xrgs.store.store import Store

#: The most ids that the name of a report lists.
_MAX_LISTED = 4


@dataclass(frozen=True)
class Choice:
    """Which rows of a sweep a report has."""

    scenes: tuple[str, ...] = ()
    """Names of scenes; empty for all."""
    ablations: tuple[str, ...] = ()
    """Labels of ablations and controls, beside what they are compared with; empty for all."""

    def rows(self, rows: Sequence[RecordedCell], against: str) -> list[RecordedCell]:
        """Return the chosen rows of a record.

        Args:
            rows: The rows.
            against: The label that all others are compared with; its rows and the baseline's stay.

        Raises:
            ReportError: No row has a scene or a label that is named; the message lists those that
                there are.
        """
        _check_known("scenes", self.scenes, [row.scene for row in rows])
        _check_known("ablations", self.ablations, [row.label for row in rows])
        labels = {*self.ablations, against, BASELINE}
        return [
            row
            for row in rows
            if (not self.scenes or row.scene in self.scenes)
            and (not self.ablations or row.label in labels)
        ]

    @property
    def suffix(self) -> str:
        """What the name of the report's folder says of the choice; empty where it is everything."""
        parts = (("scenes", self.scenes), ("ablations", self.ablations))
        return "".join(f".{key}-{for_file_name(','.join(names))}" for key, names in parts if names)


def _check_known(key: str, wanted: Iterable[str], known: Sequence[str]) -> None:
    for name in wanted:
        if name not in known:
            raise ReportError(
                f"{key}={name}: the sweep has none of that name; choose from:"
                f" {', '.join(dict.fromkeys(known))}"
            )


@dataclass(frozen=True)
class ReportStore:
    """The store from which a report is made, with renders of other programs."""

    store: Store
    external: Mapping[str, Path] = field(default_factory=dict)
    """Folders of renders that another program made, `Sweep.renders`."""

    def cell(self, cell_id: str) -> CellFolder:
        """Return the folder of a cell, which need not exist.

        Raises:
            StoreError: The id is not a valid name of a folder.
        """
        return self.store.cell(cell_id)

    def variant(self, variant_id: str) -> Path:
        """Return the folder of a variant, which need not exist.

        Raises:
            StoreError: The id is not a valid name of a folder.
        """
        return self.store.variant(variant_id)

    def variant_report(self, variant_id: str) -> SfmReport:
        """Read how a variant was made, also where its images were removed on purpose.

        Raises:
            StoreError: The store lacks the variant, or its report is damaged or can't be read now.
        """
        trimmed = trimmed_folder(self.store.variants, variant_id)
        return read_report(trimmed if trimmed.is_dir() else self.store.variant(variant_id))

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

    def without_paths(self, text: str) -> str:
        """Return a text without the path of the store: a report is the same wherever it is."""
        return text.replace(f"{self.store.path}/", "")

    def sweep_records(
        self, sweep_ids: Sequence[str]
    ) -> tuple[dict[str, tuple[str, ...]], list[RecordedCell]]:
        """Join the records of sweeps.

        Args:
            sweep_ids: Their ids.

        Returns:
            The arguments of `xrgs-sweep` of each record, by the sweep's id, and the rows of all,
            one for each scene, condition, label and replicate.

        Raises:
            StoreError: There is no such sweep, or its record is damaged.
            ReportError: Two records have different cells for one scene, condition, label and
                replicate; the message names both.
        """
        commands: dict[str, tuple[str, ...]] = {}
        rows: dict[tuple[object, ...], tuple[str, RecordedCell]] = {}
        for sweep_id in sweep_ids:
            record = self.store.sweep_record(sweep_id)
            commands[sweep_id] = record.command
            for row in record.cells:
                key = (row.scene, row.condition, row.label, row.variant_seed, row.seed)
                rows[key] = sweep_id, _same(rows.get(key), sweep_id, row)
        return commands, [row for _, row in rows.values()]


def _same(known: tuple[str, RecordedCell] | None, sweep_id: str, row: RecordedCell) -> RecordedCell:
    """Return the row that says more of two for the same cell; refuse two different cells."""
    if known is None or known[1].cell_id is None:
        return row
    before, first = known
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
    """Return the name of the folder for the report of sweeps: their ids, joined by `+`."""
    more = len(sweep_ids) - _MAX_LISTED
    listed = "+".join(sweep_ids[:_MAX_LISTED])
    return f"{listed}+{for_file_name(' '.join(sweep_ids[_MAX_LISTED:]))}" if more > 0 else listed
