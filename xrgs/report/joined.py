"""Joins the records of several sweeps of a store, and chooses the rows of a report.

A study may be trained in parts, for example scene by scene. Its report needs the rows of all
records. A store from another machine comes in through `xrgs-store import`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from xrgs.mixture.paths import trimmed_folder
from xrgs.report.collect import ReportError
from xrgs.safeio.sanitize import for_file_name
from xrgs.store.inspect import read_report
from xrgs.store.store import BASELINE, Store

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence
    from pathlib import Path

    from xrgs.store.inspect import SfmReport
    from xrgs.store.schema import RecordedCell

#: The most ids in the name of a report's folder.
_MAX_LISTED = 4


@dataclass(frozen=True)
class Choice:
    """The scenes and ablations that a report shows."""

    scenes: tuple[str, ...] = ()
    """Names of scenes; empty for all."""
    ablations: tuple[str, ...] = ()
    """Labels of ablations and controls, beside their base; empty for all."""

    def rows(self, rows: Sequence[RecordedCell], against: str) -> list[RecordedCell]:
        """Return the chosen rows of a record; those of `against` and the baseline stay.

        Raises:
            ReportError: No row has a chosen scene or label; the message lists the existing ones.
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

    def variant_report(self, variant_id: str) -> SfmReport:
        """Read the SfM report of a variant, even if its images were trimmed.

        Raises:
            StoreError: The store lacks the variant, or its report is damaged or can't be read now.
        """
        trimmed = trimmed_folder(self.variants, variant_id)
        return read_report(trimmed if trimmed.is_dir() else self.variant(variant_id))

    def render(self, cell_id: str, view: str) -> Path:
        """Return the file of the render of a view, whether or not it exists.

        Raises:
            StoreError: The cell's renders were trimmed, or its id is not a valid name.
        """
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
    ) -> tuple[dict[str, tuple[str, ...]], list[RecordedCell]]:
        """Join the records of sweeps.

        Returns:
            The id of each sweep -> the arguments of `xrgs-sweep`; and the rows of all records, one
            for each scene, condition, label and replicate.

        Raises:
            StoreError: There is no such sweep, or its record is damaged.
            ReportError: Two records have different cells for one scene, condition, label and
                replicate; the message names both.
        """
        commands: dict[str, tuple[str, ...]] = {}
        rows: dict[tuple[object, ...], tuple[str, RecordedCell]] = {}
        for sweep_id in sweep_ids:
            record = self.sweep_record(sweep_id)
            commands[sweep_id] = record.command
            for row in record.cells:
                key = (row.scene, row.condition, row.label, row.variant_seed, row.seed)
                rows[key] = sweep_id, _fuller(rows.get(key), sweep_id, row)
        return commands, [row for _, row in rows.values()]


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
