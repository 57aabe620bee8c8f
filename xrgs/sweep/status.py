"""A store at a glance: what is done, who trains what, what failed, and what other code made."""

from __future__ import annotations

import os
from collections import Counter
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from xrgs.errors import XrgsError
from xrgs.experiment.identity import training_code
from xrgs.experiment.store import State, Store
from xrgs.safeio.records import FAILED, StoreError, failed_scenes, read_json
from xrgs.safeio.untrusted import printable
from xrgs.sweep import locks

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping, Sequence
    from pathlib import Path

    from xrgs.experiment.store import CellFolder

_STATES = ("done", "running", "unfinished", "failed", "corrupt")
#: So many cells are named of each kind that wants looking at.
_NAMED = 20


@dataclass(frozen=True)
class CellSummary:
    """One cell's folder."""

    id: str
    scene: str
    label: str
    """As the latest sweep that holds the cell has them; of none, `?` for the label."""
    state: State
    stale: tuple[str, ...]
    """Of a done cell: files of the code that trained it which are not what is installed now. A
    sweep would train it again."""


@dataclass(frozen=True)
class Status:
    """What a store holds."""

    path: Path
    cells: tuple[CellSummary, ...]
    aside: int
    """Folders that a later try of the same cell has set aside, and those of reruns."""
    variants: tuple[str, ...]
    failed_scenes: tuple[tuple[str, str, str], ...]
    """Key of the variant that can't be made, scene, and why."""
    sweeps: int
    sizes: Mapping[str, int]
    """Bytes of each folder of the store."""


def read(path: Path, *, verify: bool = False) -> Status:
    """Look through a store; nothing is written.

    Args:
        path: the store's folder.
        verify: hash what reports rest on too; else a cell is corrupt where a size is wrong.

    Raises:
        StoreError: there is no such store.
    """
    store = Store(path)
    if not store.cells.is_dir():
        raise StoreError(f"store={path}: no store; xrgs-sweep makes one")
    names, sweeps = _names(store)
    held = locks.holders(store.locks)
    ids = sorted(entry.name for entry in os.scandir(store.cells) if entry.is_dir())
    cells = [name for name in ids if "." not in name]
    return Status(
        path,
        tuple(_see(store.cell(cell), names.get(cell), held, verify=verify) for cell in cells),
        len(ids) - len(cells),
        tuple(sorted(_variants(store))),
        tuple((key, *why) for key, why in failed_scenes(store.variants).items()),
        sweeps,
        {folder.name: _bytes(folder.path) for folder in os.scandir(path) if folder.is_dir()},
    )


def _variants(store: Store) -> Iterator[str]:
    """Those that are frozen; not what is being built, and not the reports of those that failed."""
    for folder in store.variants.glob("[!.]*-*"):
        if not folder.name.startswith(FAILED):
            yield folder.name


def _names(store: Store) -> tuple[dict[str, tuple[str, str]], int]:
    """Scene and label of every cell that a sweep recorded, the latest sweep's; and the sweeps."""
    names: dict[str, tuple[str, str]] = {}
    files = sorted((store.path / "sweeps").glob("*.json"), key=lambda file: file.stat().st_mtime_ns)
    for file in files:
        try:
            for row in store.sweep_record(file.stem)["cells"]:
                label = " ".join(part for part in (row["label"], row["condition"]) if part)
                names[row["cell_id"]] = (row["scene"], label)
        except (StoreError, KeyError):
            continue
    return names, len(files)


def _see(
    cell: CellFolder,
    name: tuple[str, str] | None,
    held: Mapping[str, locks.Owner | None],
    *,
    verify: bool,
) -> CellSummary:
    state = cell.state(verify=verify)
    if state.name != "done" and cell.id in held:
        state = cell.running(held[cell.id])
    scene, label = name or (_scene(cell), "?")
    return CellSummary(cell.id, scene, label, state, _stale(cell) if state.name == "done" else ())


def _scene(cell: CellFolder) -> str:
    """Of a cell that no sweep has recorded yet."""
    try:
        scene = read_json(cell.path / "config.json")["scene"]
        return str(scene["name"] or scene["path"] or scene["kind"])
    except (StoreError, KeyError, TypeError):
        return "?"


def _stale(cell: CellFolder) -> tuple[str, ...]:
    try:
        identity = cell.identity()
        then: dict[str, Any] = identity["code"]
        now = training_code(identity["splat"]["backend"])
        if then == now:
            return ()
        return tuple(
            sorted(file for file in then.keys() | now.keys() if then.get(file) != now.get(file))
        )
    except (XrgsError, AttributeError, KeyError, TypeError, ValueError):
        return ("identity.json",)


def _bytes(folder: str) -> int:
    total = 0
    for entry in _walk(folder):
        try:
            total += entry.stat(follow_symlinks=False).st_size
        except OSError:  # gone while it was looked at
            continue
    return total


def _walk(folder: str) -> Iterator[os.DirEntry[str]]:
    try:
        entries = list(os.scandir(folder))
    except OSError:
        return
    for entry in entries:
        if entry.is_dir(follow_symlinks=False):
            yield from _walk(entry.path)
        else:
            yield entry


def describe(status: Status) -> str:
    """The store as text."""
    counts = Counter(cell.state.name for cell in status.cells)
    stale = [cell for cell in status.cells if cell.stale]
    parts = [f"{counts[state]} {state}" for state in _STATES if counts[state]]
    lines = [f"store {status.path}: {len(status.cells)} cells", "  " + (", ".join(parts) or "none")]
    if status.aside:
        lines.append(f"  {status.aside} folders of earlier tries and reruns (*.*)")
    lines.append(f"  {len(status.variants)} variants, {status.sweeps} sweeps recorded")
    sizes = ", ".join(f"{name} {_size(size)}" for name, size in sorted(status.sizes.items()))
    lines += [f"  {_size(sum(status.sizes.values()))} on disk: {sizes}", ""]
    lines += _table(status.cells)
    for state in ("running", "failed", "corrupt", "unfinished"):
        lines += _named(state, [cell for cell in status.cells if cell.state.name == state])
    if status.failed_scenes:
        lines += ["", "failed scenes, left as they are: retry=failed tries them again"]
        lines += [
            printable(f"  {key}  {scene}  {reason.partition(chr(10))[0]}")
            for key, scene, reason in status.failed_scenes[:_NAMED]
        ]
    if stale:
        files = Counter(file for cell in stale for file in cell.stale)
        lines += ["", f"stale: {len(stale)} done cells are of other code than what is installed"]
        lines += [f"  {file}: {count} cells" for file, count in files.most_common(_NAMED)]
    return "\n".join(lines)


def _table(cells: Sequence[CellSummary]) -> list[str]:
    """Cells of each scene and label by state; columns without a cell are left out."""
    counts: dict[tuple[str, str], Counter[str]] = {}
    for cell in cells:
        row = counts.setdefault((cell.scene, cell.label), Counter())
        row[cell.state.name] += 1
        row["stale"] += bool(cell.stale)
    columns = [c for c in (*_STATES, "stale") if any(row[c] for row in counts.values())]
    rows = [("scene", "label", *columns)]
    rows += [
        (*map(printable, key), *(str(row[column] or "") for column in columns))
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


def _named(state: str, cells: Sequence[CellSummary]) -> list[str]:
    if not cells:
        return []
    lines = ["", f"{state}:"]
    for cell in cells[:_NAMED]:
        reason = cell.state.reason.partition("\n")[0]
        lines.append(printable(f"  {cell.id}  {cell.scene} / {cell.label}  {reason}"))
    if len(cells) > _NAMED:
        lines.append(f"  and {len(cells) - _NAMED} more")
    return lines


def _size(count: int) -> str:
    size = float(count)
    for unit in ("B", "kB", "MB"):
        if size < 999.5:
            return f"{size:.0f} {unit}"
        size /= 1000
    return f"{size:.1f} GB"
