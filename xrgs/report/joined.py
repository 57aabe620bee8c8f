"""Reads several stores and several sweeps as one, and chooses rows of them, for one report.

A study may be trained in parts: scene by scene, on two machines, each into a store of its own. Its
report needs the rows of all records, and finds each cell in the store where it is done.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from xrgs.errors import StoreError
from xrgs.mixture.paths import trimmed_folder
from xrgs.report.collect import ReportError
from xrgs.safeio.sanitize import for_file_name
from xrgs.store.inspect import read_report
from xrgs.store.store import BASELINE

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence

    from xrgs.store.cell_folder import CellFolder
    from xrgs.store.inspect import SfmReport
    from xrgs.store.schema import RecordedCell, SweepRecord
    from xrgs.store.store import Store

_T = TypeVar("_T")
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
class JoinedStore:
    """One or several stores from which a report is made; nothing is written through it."""

    stores: tuple[Store, ...]
    """The stores; of a cell that several have done, the first counts."""
    external: Mapping[str, Path] = field(default_factory=dict)
    """Folders of renders that another program made, `Sweep.renders`."""

    def cell(self, cell_id: str) -> CellFolder:
        """Return the folder of a cell, in the store where it is done if there is one.

        Raises:
            StoreError: The id is not a valid name of a folder.
        """
        return _first([store.cell(cell_id) for store in self.stores], _is_done, _is_there)

    def variant(self, variant_id: str) -> Path:
        """Return the folder of a variant, in a store that has it if there is one.

        Raises:
            StoreError: The id is not a valid name of a folder.
        """
        return _first([store.variant(variant_id) for store in self.stores], Path.is_dir)

    def variant_report(self, variant_id: str) -> SfmReport:
        """Read how a variant was made, also where its images were removed on purpose.

        Raises:
            StoreError: No store has the variant, or its report is damaged or can't be read now.
        """
        homes = [
            home
            for store in self.stores
            for home in (store.variant(variant_id), trimmed_folder(store.variants, variant_id))
        ]
        return read_report(_first(homes, Path.is_dir))

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
        """Return a text without the paths of the stores: a report is the same wherever they are."""
        for store in self.stores:
            text = text.replace(f"{store.path}/", "")
        return text

    def latest_sweeps(self) -> tuple[str, ...]:
        """Return the id of each store's latest sweep, without repetitions.

        Raises:
            StoreError: A store has no record of a sweep, or none that can be read.
        """
        return tuple(dict.fromkeys(store.latest_sweep() for store in self.stores))

    def sweep_records(
        self, sweep_ids: Sequence[str]
    ) -> tuple[dict[str, tuple[str, ...]], list[RecordedCell]]:
        """Join the records of sweeps.

        Args:
            sweep_ids: Their ids; each is a sweep of one of the stores, or of several.

        Returns:
            The arguments of `xrgs-sweep` of each record, by the sweep's id, and the rows of all,
            one for each scene, condition, label and replicate.

        Raises:
            StoreError: No store has such a sweep, or its record is damaged.
            ReportError: Two records have different cells for one scene, condition, label and
                replicate; the message names both.
        """
        commands: dict[str, tuple[str, ...]] = {}
        rows: dict[tuple[object, ...], tuple[str, RecordedCell]] = {}
        for sweep_id in sweep_ids:
            for record in self._records(sweep_id):
                commands[sweep_id] = record.command
                for row in record.cells:
                    key = (row.scene, row.condition, row.label, row.variant_seed, row.seed)
                    rows[key] = sweep_id, _same(rows.get(key), sweep_id, row)
        return commands, [row for _, row in rows.values()]

    def _records(self, sweep_id: str) -> list[SweepRecord]:
        having = [store for store in self.stores if sweep_id in store.sweep_ids()]
        if not having and len(self.stores) > 1:
            paths = ", ".join(str(store.path) for store in self.stores)
            raise StoreError(f"sweep={sweep_id}: there is no such sweep in {paths}")
        return [store.sweep_record(sweep_id) for store in having or self.stores]


def _first(found: Sequence[_T], *wanted: Callable[[_T], bool]) -> _T:
    """Return the first that satisfies the first condition, else the next one; else the first."""
    conditions = wanted if len(found) > 1 else ()  # one alone is returned without a look at it
    fitting = (one for condition in conditions for one in found if condition(one))
    return next(fitting, found[0])


def _is_done(cell: CellFolder) -> bool:
    return cell.state(verify=False).name == "done"


def _is_there(cell: CellFolder) -> bool:
    return cell.path.is_dir()


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
