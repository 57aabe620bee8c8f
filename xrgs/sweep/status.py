"""Summarises a store: what is done, running, failed, and trained by another version of the code."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, TypeVar

from xrgs.capture.folders import failed_scenes, is_variant
from xrgs.errors import StoreError
from xrgs.experiment.store import Store
from xrgs.runtime import lease
from xrgs.safeio.files import file_bytes, is_name
from xrgs.safeio.records import list_folder
from xrgs.safeio.sanitize import MAX_CELL, counted, for_line
from xrgs.sweep.inventory import STATES, CellNames, recorded_names, size_text, summarise

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence
    from pathlib import Path

    from xrgs.sweep.inventory import CellSummary

_T = TypeVar("_T")
#: Cells of each state are listed by name up to this number.
_MAX_NAMED = 20


@dataclass(frozen=True)
class StoreStatus:
    """What a store holds."""

    path: Path
    """The store's folder."""
    cells: tuple[CellSummary, ...]
    aside: int
    """Number of folders of earlier attempts that were set aside, and of reruns."""
    variants: tuple[str, ...]
    """Ids of the frozen variants."""
    failed_scenes: tuple[tuple[str, str, str], ...]
    """Scenes that no variant could be made of: the variant's key, the scene, and the reason."""
    sweeps: int
    """Number of recorded sweeps."""
    sizes: Mapping[str, int | None]
    """Bytes of each subfolder of the store, links not counted; None where that can't be told."""
    problems: tuple[str, ...]
    """What can't be read, or is not what a store has: a line for each file or folder."""


def read(path: Path) -> StoreStatus:
    """Read the state of a store; nothing is written.

    Of the cells' files the sizes are compared. What can't be read is named among the problems, and
    does not hide the rest.

    Args:
        path: The store's folder.

    Raises:
        StoreError: There is no such store, or it can't be read now.
    """
    store = Store(path)
    if not store.exists:
        raise StoreError(f"store={path} is not a store; xrgs-sweep makes one")
    problems = _Problems()
    names, sweeps = _names(store, problems)
    holders = lease.holders(store.leases)
    cells = problems.unless(store.cell_folders) or []
    return StoreStatus(
        path=path,
        cells=tuple(summarise(cell, names, holders) for cell in cells),
        aside=_aside(store, problems),
        variants=tuple(problems.unless(lambda: _variants(store, problems)) or []),
        failed_scenes=tuple(problems.unless(lambda: _failed_scenes(store)) or []),
        sweeps=sweeps,
        sizes=_sizes(store, problems),
        problems=tuple(problems),
    )


class _Problems(list[str]):
    """Lines that name what can't be read."""

    def unless(self, look: Callable[[], _T]) -> _T | None:
        """Return what a function reads; where it can't, add a line, and return None.

        Args:
            look: Reads something of the store.
        """
        try:
            return look()
        except StoreError as error:
            self.append(str(error))
        except OSError as error:
            self.append(f"{error.filename}: {error.strerror}")
        return None


def _aside(store: Store, problems: _Problems) -> int:
    """Count the folders of earlier attempts; add a problem for each name that no cell has."""
    names = problems.unless(lambda: list_folder(store.cells_folder)) or []
    wrong = [name for name in names if not is_name(name)]
    problems += [f"{store.cells_folder}/{name}: a cell can't have this name" for name in wrong]
    return sum("." in name and is_name(name) for name in names)


def _variants(store: Store, problems: _Problems) -> list[str]:
    """Return the frozen variants: not those being built, and not the reports of failed ones."""
    names = [name for name in list_folder(store.variants) if is_variant(name)]
    folders = {name for name in names if (store.variants / name).is_dir()}
    problems += [f"{store.variants}/{n}: not a folder" for n in names if n not in folders]
    return [name for name in names if name in folders]


def _failed_scenes(store: Store) -> list[tuple[str, str, str]]:
    if not list_folder(store.variants):
        return []
    return [(key, *why) for key, why in failed_scenes(store.variants).items()]


def _sizes(store: Store, problems: _Problems) -> dict[str, int | None]:
    names = problems.unless(lambda: list_folder(store.path)) or []
    folders = [name for name in names if (store.path / name).is_dir()]
    return {name: problems.unless(partial(file_bytes, store.path / name)) for name in folders}


def _names(store: Store, problems: _Problems) -> tuple[dict[str, CellNames], int]:
    """Return the names of every recorded cell, and the number of recorded sweeps."""
    records, damaged = problems.unless(store.records) or ({}, ())
    problems += damaged
    return recorded_names(records), len(records) + len(damaged)


def describe(status: StoreStatus) -> str:
    """Return the state of a store as text.

    Args:
        status: The state, from `read`.
    """
    counts = Counter(cell.state.name for cell in status.cells)
    stale = [cell for cell in status.cells if cell.stale]
    parts = [f"{counts[state]} {state}" for state in STATES if counts[state]]
    lines = [f"store {status.path}: {counted(len(status.cells), 'cell')}"]
    lines.append(f"  {', '.join(parts) or 'none'}")
    if status.aside:
        lines.append(f"  {counted(status.aside, 'folder')} of earlier attempts and reruns (*.*)")
    variants, sweeps = len(status.variants), status.sweeps
    lines.append(f"  {counted(variants, 'variant')}, {counted(sweeps, 'sweep')} recorded")
    lines += [_disk(status.sizes), ""]
    lines += _table(status.cells)
    for state in ("running", "failed", "corrupt", "unknown", "unfinished"):
        lines += _listed(state, [cell for cell in status.cells if cell.state.name == state])
    if status.failed_scenes:
        lines += ["", "failed scenes, not tried again; retry=failed tries them again"]
        lines += [
            f"  {key}  {scene}  {reason.partition(chr(10))[0]}"
            for key, scene, reason in status.failed_scenes[:_MAX_NAMED]
        ]
    if stale:
        files = Counter(file for cell in stale for file in cell.stale)
        lines += [
            "",
            f"stale: {counted(len(stale), 'done cell')} of other code or arithmetic than here",
        ]
        lines += [
            f"  {file}: {counted(count, 'cell')}" for file, count in files.most_common(_MAX_NAMED)
        ]
    lines += _named("can't be read, or does not belong there:", status.problems, _MAX_NAMED)
    return "\n".join(map(for_line, lines))


def _disk(sizes: Mapping[str, int | None]) -> str:
    """Return a line of the sizes of the store's folders."""
    texts = [f"{name} {size_text(size)}" for name, size in sorted(sizes.items())]
    known = size_text(sum(size or 0 for size in sizes.values()))
    return f"  {known} on disk{' at least' * (None in sizes.values())}: {', '.join(texts)}"


def _named(heading: str, names: Sequence[str], most: int) -> list[str]:
    if not names:
        return []
    more = [f"  and {len(names) - most} more"] if len(names) > most else []
    return ["", heading, *(f"  {name}" for name in names[:most]), *more]


def _table(cells: Sequence[CellSummary]) -> list[str]:
    """Return a table of the cells of each scene and label by state, without empty columns."""
    counts: dict[tuple[str, str], Counter[str]] = {}
    for cell in cells:
        row = counts.setdefault((cell.names.scene, cell.arm), Counter())
        row[cell.state.name] += 1
        row["stale"] += bool(cell.stale)
    columns = [c for c in (*STATES, "stale") if any(row[c] for row in counts.values())]
    rows = [("scene", "label", *columns)]
    rows += [
        (
            *(for_line(name, MAX_CELL) for name in key),
            *(str(row[column] or "") for column in columns),
        )
        for key, row in sorted(counts.items())
    ]
    return _aligned(rows) if cells else []


def _aligned(rows: Iterable[tuple[str, ...]]) -> list[str]:
    rows = list(rows)
    sizes = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return [
        "  ".join(
            text.ljust(size) if number < 2 else text.rjust(size)
            for number, (text, size) in enumerate(zip(row, sizes, strict=True))
        ).rstrip()
        for row in rows
    ]


def _listed(state: str, cells: Sequence[CellSummary]) -> list[str]:
    reasons = [cell.state.reason.partition("\n")[0] for cell in cells]
    # The latest of the sweeps that have it is the one that trains it now.
    sweeps = [cell.names.sweeps[-1:] if state == "running" else () for cell in cells]
    names = [
        cell.name + "".join(f"  sweep {sweep_id}" for sweep_id in of)
        for cell, of in zip(cells, sweeps, strict=True)
    ]
    lines = [f"{name}  {reason}" for name, reason in zip(names, reasons, strict=True)]
    return _named(f"{state}:", lines, _MAX_NAMED)
