"""Summarises a store: its cells by state, cells of other code, failed scenes, and sizes."""

from __future__ import annotations

import sys
import time
from collections import Counter
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, TypeVar

from xrgs.errors import StoreError
from xrgs.mixture.paths import TO_TRY, failed_scenes, is_variant
from xrgs.runtime import lease, progress
from xrgs.runtime.streams import is_terminal, redraw, say
from xrgs.runtime.text import TextTable, format_size, to_text
from xrgs.safeio.files import file_bytes, is_name
from xrgs.safeio.records import list_folder
from xrgs.safeio.sanitize import counted, for_line
from xrgs.store.listing import STATES, latest_records
from xrgs.store.store import Store

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence
    from pathlib import Path

    from xrgs.store.listing import CellRow
    from xrgs.store.schema import RecordedCell

_T = TypeVar("_T")
#: The most cells, scenes or problems that are listed by name under one heading.
_MAX_NAMED = 20
#: Least seconds between two looks of `watch` on a terminal, and seconds between two in a log.
_WATCH_S, _LOG_S = 2.0, 60.0
#: The pause after a look is at least this many times as long as the look took, so that a slow store
#: is not kept busy.
_PAUSE_FACTOR = 20


@dataclass(frozen=True)
class StoreStatus:
    """The content of a store."""

    path: Path
    """The store's folder."""
    cells: tuple[CellRow, ...]
    aside: int
    """Number of folders of earlier attempts that were set aside, and of reruns."""
    variants: tuple[str, ...]
    """Ids of the frozen variants."""
    failed_scenes: tuple[str, ...]
    """A line for each scene without a variant because SfM failed: the variant's key, and why."""
    sweeps: int
    """Number of recorded sweeps."""
    sizes: Mapping[str, int | None]
    """Bytes of each subfolder of the store; None where its files can't be listed."""
    problems: tuple[str, ...]
    """A line for each file or folder that can't be read, or that does not belong in a store."""


def read(path: Path) -> StoreStatus:
    """Read the state of a store, and write nothing.

    The cells' files are checked by their sizes only. A file that can't be read is named among the
    problems, and does not hide the rest.

    Raises:
        StoreError: There is no such store, or it can't be read now.
    """
    store, problems = Store(path), _Problems()
    store.check_exists()
    records, damaged = problems.note_error(store.records) or ({}, ())
    problems += damaged
    cells = problems.note_error(partial(store.cell_rows, records)) or []
    return StoreStatus(
        path=path,
        cells=tuple(cells),
        aside=_aside(store, problems),
        variants=tuple(problems.note_error(lambda: _variants(store, problems)) or []),
        failed_scenes=tuple(problems.note_error(partial(_failed_scenes, store)) or []),
        sweeps=len(records) + len(damaged),
        sizes=_sizes(store, problems),
        problems=tuple(problems),
    )


class _Problems(list[str]):
    """Lines that name files and folders that can't be read."""

    def note_error(self, look: Callable[[], _T]) -> _T | None:
        """Return the result of a function; if it can't read a file, add a line and return None."""
        try:
            return look()
        except StoreError as error:
            self.append(str(error))
        except OSError as error:
            self.append(f"{error.filename}: {error.strerror}")
        return None


def _aside(store: Store, problems: _Problems) -> int:
    """Count the folders of earlier attempts; add a problem for each name that no cell has."""
    names = problems.note_error(lambda: list_folder(store.cells_folder)) or []
    wrong = [name for name in names if not is_name(name)]
    problems += [f"{store.cells_folder}/{name}: a cell can't have this name" for name in wrong]
    return sum("." in name and is_name(name) for name in names)


def _variants(store: Store, problems: _Problems) -> list[str]:
    """Return the frozen variants, without unfinished ones and reports of failed scenes."""
    names = [name for name in list_folder(store.variants) if is_variant(name)]
    folders = {name for name in names if (store.variants / name).is_dir()}
    problems += [f"{store.variants}/{n}: not a folder" for n in names if n not in folders]
    return [name for name in names if name in folders]


def _failed_scenes(store: Store) -> list[str]:
    if not list_folder(store.variants):
        return []
    return ["  ".join((key, *why)) for key, why in failed_scenes(store.variants).items()]


def _sizes(store: Store, problems: _Problems) -> dict[str, int | None]:
    names = problems.note_error(lambda: list_folder(store.path)) or []
    folders = [name for name in names if (store.path / name).is_dir()]
    return {name: problems.note_error(partial(file_bytes, store.path / name)) for name in folders}


def describe(status: StoreStatus) -> str:
    """Return the state of a store as text."""
    counts = Counter(cell.state.name for cell in status.cells)
    stale = [cell for cell in status.cells if cell.stale]
    parts = [f"{counts[state]} {state}" for state in STATES if counts[state]]
    lines = [f"store {status.path}: {counted(len(status.cells), 'cell')}"]
    lines.append(f"  {', '.join(parts) or 'none'}")
    if status.aside:
        lines.append(f"  {counted(status.aside, 'folder')} of earlier attempts and reruns (*.*)")
    variants, sweeps = len(status.variants), status.sweeps
    lines.append(f"  {counted(variants, 'variant')}, {counted(sweeps, 'sweep')} recorded")
    lines += [_disk(status.sizes), *_table(status.cells)]
    done = sorted((c for c in status.cells if c.state.name == "done"), key=lambda c: c.age_s or 0)
    lines += _named("done, the latest first:", [cell.name for cell in done], "xrgs-store list")
    for state in ("running", "failed", "corrupt", "unfinished"):
        of_state = [cell for cell in status.cells if cell.state.name == state]
        lines += _named(f"{state}:", [_reason(cell) for cell in of_state])
    failed = status.failed_scenes
    lines += _named("failed scenes, not tried again; retry=failed tries them again", failed)
    lines += TO_TRY if failed else ()
    changed = Counter(part for cell in stale for part in cell.stale)
    title = f"stale: {counted(len(stale), 'done cell')} of other code or arithmetic than here"
    lines += _named(title, [f"{part}: {counted(n, 'cell')}" for part, n in changed.most_common()])
    lines += _named("can't be read, or does not belong there:", status.problems)
    return "\n".join(map(for_line, lines))


def _disk(sizes: Mapping[str, int | None]) -> str:
    texts = [f"{name} {format_size(size)}" for name, size in sorted(sizes.items())]
    total = format_size(sum(size or 0 for size in sizes.values()))
    return f"  {total} on disk{' at least' * (None in sizes.values())}: {', '.join(texts)}"


def _table(cells: Sequence[CellRow]) -> list[str]:
    """Return a table of the cells of each scene and label by state, without empty columns."""
    if not cells:
        return []
    counts: dict[tuple[str, str], Counter[str]] = {}
    for cell in cells:
        row = counts.setdefault((cell.scene, cell.arm), Counter())
        row[cell.state.name] += 1
        row["stale"] += bool(cell.stale)
    columns = [c for c in (*STATES, "stale") if any(row[c] for row in counts.values())]
    rows = [(*key, *(str(row[c] or "") for c in columns)) for key, row in sorted(counts.items())]
    heads, align = ("scene", "label", *columns), "ll" + "r" * len(columns)
    return to_text(TextTable("", heads, tuple(rows), align)).rstrip().split("\n")


def _reason(cell: CellRow) -> str:
    # The latest of the sweeps that have a running cell is the one that trains it now.
    sweep = f"  sweep {cell.sweeps[-1]}" if cell.state.name == "running" and cell.sweeps else ""
    return f"{cell.name}{sweep}  {cell.state.reason.partition(chr(10))[0]}"


def _named(heading: str, names: Sequence[str], command: str = "") -> list[str]:
    """Return a heading with the first names below it; `command` lists all of them."""
    if not names:
        return []
    left = len(names) - _MAX_NAMED
    more = [f"  and {left} more{command and f': {command} has all'}"] if left > 0 else []
    return ["", heading, *(f"  {name}" for name in names[:_MAX_NAMED]), *more]


def watch(path: Path) -> None:
    """Show the cells in training until Ctrl-C, on a terminal in place; raises as `read`."""
    store, drawn, pause = Store(path), 0, _WATCH_S
    store.check_exists()
    with suppress(KeyboardInterrupt):
        while True:
            start = time.monotonic()
            text = running(store)
            if is_terminal(sys.stdout):
                drawn = redraw(text, drawn, sys.stdout)
                pause = max(_WATCH_S, _PAUSE_FACTOR * (time.monotonic() - start))
            else:
                say(text)
                pause = _LOG_S
            time.sleep(pause)


def running(store: Store) -> str:
    """Return lines for `watch`: the time, the running sweeps, and the progress of their cells."""
    records, _ = store.records()
    training = {
        cell_id: now
        for cell_id in lease.holders(store.leases)
        if (now := progress.read(store.cell(cell_id).progress))
    }
    lines = [f"{time.strftime('%H:%M:%S')}  {counted(len(training), 'cell')} in training"]
    # A cell of several sweeps is trained by the latest one.
    sweeps = {row.cell_id: name for name, record in records.items() for row in record.cells}
    for name in sorted({sweeps[cell_id] for cell_id in training if cell_id in sweeps}):
        rows = records[name].cells
        ids = {row.cell_id for row in rows if row.cell_id}
        done = sum(store.cell(cell_id).state(verify=False).name == "done" for cell_id in ids)
        lines.append(f"sweep {name}: {done} of {counted(len(rows), 'cell')} done")
    names = latest_records(records)
    lines += [f"  {_name(i, names.get(i))}: {training[i]}" for i in sorted(training)]
    return "\n".join(map(for_line, lines))


def _name(cell_id: str, row: RecordedCell | None) -> str:
    """Return scene, label, condition and replicate of a cell; its id where no sweep has it."""
    if row is None:
        return cell_id
    replicate = f"replicate {row.variant_seed}/{row.seed}"
    return " / ".join(filter(None, (row.scene, row.label, row.condition, replicate)))
