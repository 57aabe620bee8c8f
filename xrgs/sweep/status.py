"""Summarises a store: what is done, running, failed, and trained by another version of the code."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from xrgs.capture.failures import FAILED_PREFIX, failed_scenes
from xrgs.errors import StoreError, XrgsError
from xrgs.experiment.cell_folder import CellState
from xrgs.experiment.identity import training_code
from xrgs.experiment.store import Store
from xrgs.safeio.records import read_json
from xrgs.safeio.words import MAX_CELL, for_line
from xrgs.splat.backend import arithmetic
from xrgs.sweep import locks
from xrgs.training import plugins

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping, Sequence
    from pathlib import Path

    from xrgs.experiment.cell_folder import CellFolder
    from xrgs.safeio.confined import ConfinedPath

_STATES = ("done", "running", "unfinished", "failed", "corrupt")
#: Cells of each state are listed by name up to this number.
_MAX_NAMED = 20


@dataclass(frozen=True)
class CellSummary:
    """The state of one cell's folder."""

    id: str
    scene: str
    """The scene's label in the latest sweep that has the cell, else from the cell's config."""
    label: str
    """The cell's label and condition in that sweep, `?` if no sweep has the cell."""
    state: CellState
    stale: tuple[str, ...]
    """For a done cell, source files that have changed since it was trained, and its arithmetic if
    this machine has another. A sweep would train the cell again."""


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
    sizes: Mapping[str, int]
    """Bytes of each subfolder of the store."""


def read(path: Path, *, verify: bool = False) -> StoreStatus:
    """Read the state of a store; nothing is written.

    Args:
        path: The store's folder.
        verify: Hash the files that reports are made from; otherwise only sizes are compared.

    Raises:
        StoreError: There is no such store.
    """
    store = Store(path)
    if not store.exists:
        raise StoreError(f"store={path} is not a store; xrgs-sweep makes one")
    names, sweeps = _names(store)
    holders = locks.holders(store.locks)
    cells = store.cell_folders()
    return StoreStatus(
        path,
        tuple(_summarise(cell, names.get(cell.id), holders, verify=verify) for cell in cells),
        len(store.cells_folder.folders()) - len(cells),
        tuple(sorted(_variants(store))),
        tuple((key, *why) for key, why in failed_scenes(store.variants).items()),
        sweeps,
        {name: _bytes(store.folder / name) for name in store.folder.folders()},
    )


def _variants(store: Store) -> Iterator[str]:
    """Yield the frozen variants: not those being built, and not the reports of failed ones."""
    for name in store.variants.folders():
        if "-" in name and not name.startswith((".", FAILED_PREFIX)):
            yield name


def _names(store: Store) -> tuple[dict[str, tuple[str, str]], int]:
    """Return scene and label of every recorded cell, and the number of recorded sweeps."""
    names: dict[str, tuple[str, str]] = {}
    records, damaged = store.records()
    for record in records.values():
        for row in record["cells"]:
            label = " ".join(row[key] for key in ("label", "condition") if row.get(key))
            names[row.get("cell_id")] = (row.get("scene", "?"), label)
    return names, len(records) + len(damaged)


def _summarise(
    cell: CellFolder,
    name: tuple[str, str] | None,
    holders: Mapping[str, str],
    *,
    verify: bool,
) -> CellSummary:
    state = cell.state(verify=verify)
    if state.name != "done" and cell.id in holders:
        state = cell.running(holders[cell.id])
    scene, label = name or (_scene(cell), "?")
    return CellSummary(cell.id, scene, label, state, _stale(cell) if state.name == "done" else ())


def _scene(cell: CellFolder) -> str:
    """Return the scene of a cell that no sweep has recorded yet."""
    try:
        scene = read_json(cell.folder / "config.json")["scene"]
        return str(scene["name"] or scene["path"] or scene["kind"])
    except (StoreError, KeyError, TypeError):
        return "?"


def _stale(cell: CellFolder) -> tuple[str, ...]:
    """Return the source files that are not the ones that the cell was trained with.

    The cell's arithmetic is among them where it is not this machine's.
    """
    try:
        identity = cell.identity()
        then: dict[str, Any] = identity["code"]
        backend = identity["splat"]["backend"]
        now = training_code(backend) | plugins.digests_now(then)
        files = then.keys() | now.keys() if then != now else ()
        changed = sorted(file for file in files if then.get(file) != now.get(file))
        return (*changed, *_other_arithmetic(backend, identity.get("arithmetic", "not recorded")))
    except (XrgsError, AttributeError, KeyError, TypeError, ValueError):
        return ("identity.json",)


def _other_arithmetic(backend: str, trained: object) -> list[str]:
    """Return how a cell's arithmetic differs from this machine's; empty if it does not.

    A machine on which the backend is not available, where stores are only read, has none.
    """
    try:
        here = arithmetic(backend)
    except XrgsError:
        return []
    return [] if trained == here else [f"arithmetic ({trained}, here {here})"]


def _bytes(folder: ConfinedPath) -> int:
    return sum(status.st_size for _, status in folder.walk())


def describe(status: StoreStatus) -> str:
    """Return the state of a store as text.

    Args:
        status: The state, from `read`.
    """
    counts = Counter(cell.state.name for cell in status.cells)
    stale = [cell for cell in status.cells if cell.stale]
    parts = [f"{counts[state]} {state}" for state in _STATES if counts[state]]
    lines = [f"store {status.path}: {len(status.cells)} cells", "  " + (", ".join(parts) or "none")]
    if status.aside:
        lines.append(f"  {status.aside} folders of earlier attempts and reruns (*.*)")
    lines.append(f"  {len(status.variants)} variants, {status.sweeps} sweeps recorded")
    sizes = ", ".join(f"{name} {_size(size)}" for name, size in sorted(status.sizes.items()))
    lines += [f"  {_size(sum(status.sizes.values()))} on disk: {sizes}", ""]
    lines += _table(status.cells)
    for state in ("running", "failed", "corrupt", "unfinished"):
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
            f"stale: {len(stale)} done cells were trained with other code or arithmetic than here",
        ]
        lines += [f"  {file}: {count} cells" for file, count in files.most_common(_MAX_NAMED)]
    return "\n".join(map(for_line, lines))


def _table(cells: Sequence[CellSummary]) -> list[str]:
    """Return a table of the cells of each scene and label by state, without empty columns."""
    counts: dict[tuple[str, str], Counter[str]] = {}
    for cell in cells:
        row = counts.setdefault((cell.scene, cell.label), Counter())
        row[cell.state.name] += 1
        row["stale"] += bool(cell.stale)
    columns = [c for c in (*_STATES, "stale") if any(row[c] for row in counts.values())]
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
    if not cells:
        return []
    lines = ["", f"{state}:"]
    for cell in cells[:_MAX_NAMED]:
        reason = cell.state.reason.partition("\n")[0]
        lines.append(f"  {cell.id}  {cell.scene} / {cell.label}  {reason}")
    if len(cells) > _MAX_NAMED:
        lines.append(f"  and {len(cells) - _MAX_NAMED} more")
    return lines


def _size(count: int) -> str:
    size = float(count)
    for unit in ("B", "kB", "MB"):
        if size < 999.5:
            return f"{size:.0f} {unit}"
        size /= 1000
    return f"{size:.1f} GB"
