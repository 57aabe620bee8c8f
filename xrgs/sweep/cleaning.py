"""Removes cells and variants from a store, or their heavy files, in two steps.

A plan lists what would be removed, with sizes. `carry_out` then removes it. Each cell is removed or
trimmed under its lease, so that a cell in training, here or on another machine, is left alone.
"""

from __future__ import annotations

import re
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import nullcontext, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from xrgs.errors import StoreError, XrgsError
from xrgs.mixture import paths
from xrgs.runtime import lease
from xrgs.runtime.text import format_size
from xrgs.safeio.files import is_name, remove_path
from xrgs.safeio.records import list_folder
from xrgs.safeio.sanitize import counted, for_line
from xrgs.store import trimming
from xrgs.store.attempts import remove_cell
from xrgs.store.listing import CellRow, size_of
from xrgs.store.store import Store

#: What `gc` removes, by the names that choose it.
GARBAGE = ("old_code", "failed", "aside", "variants")
#: Names of folders in `cells/` and `variants/` that were set aside, or that a killed removal has
#: left. Either group is the id of the cell, which is also the name of its lease.
_ASIDE = re.compile(r"\.?(?P<id>[^.]+)\.aside-\d+|\.(?P<rest>[^.]+)\.new-[0-9a-f]+")
#: Seconds for which a new variant is kept without a cell: a sweep may be about to begin one.
_NEW_S = 3600.0
_RUNNING = "variants are left alone: a sweep is running, and may need any of them"
#: The most names that a plan lists of each kind.
_MAX_NAMED = 20


@dataclass(frozen=True)
class Item:
    """One thing that is removed or trimmed."""

    kind: str
    """In the plural: `cells of old code`."""
    name: str
    bytes: int
    lease: str | None
    """The name of the lease to hold while it is removed."""
    act: Callable[[], str | None]
    """Removes the thing; returns the reason where it is left."""


@dataclass(frozen=True)
class Plan:
    """Things to remove or trim, and notes on things that are left alone."""

    verb: str
    """`remove` or `trim`."""
    items: tuple[Item, ...]
    notes: tuple[str, ...] = ()
    """Lines on things that are left alone, with the reasons."""

    @property
    def total(self) -> str:
        """A line such as `cells of old code (12), variants (3): 340 MB`."""
        counts = Counter(item.kind for item in self.items)
        size = format_size(sum(item.bytes for item in self.items))
        return f"{', '.join(f'{kind} ({count})' for kind, count in counts.items())}: {size}"

    def __str__(self) -> str:
        lines = [f"to {self.verb}: {self.total}" if self.items else f"nothing to {self.verb}"]
        for kind in dict.fromkeys(item.kind for item in self.items):
            of_kind = [item for item in self.items if item.kind == kind]
            lines.append(f"{kind}: {format_size(sum(item.bytes for item in of_kind))}")
            lines += [f"  {item.name}  {format_size(item.bytes)}" for item in of_kind[:_MAX_NAMED]]
            more = len(of_kind) - _MAX_NAMED
            lines += [f"  and {more} more"] if more > 0 else []
        return "\n".join(map(for_line, [*lines, *self.notes]))


def plan_removal(store: Store, cells: Sequence[CellRow]) -> Plan:
    """Plan to remove cells; cells in training are left alone."""
    chosen, notes = _without_running(cells)
    return Plan("remove", tuple(_removals(store, "cells", chosen)), (*notes, *_recorded(chosen)))


def plan_trim(
    store: Store, cells: Sequence[CellRow], chosen: Sequence[CellRow], *, variants: bool
) -> Plan:
    """Plan to remove the Gaussians and renders of chosen cells that are done.

    With `variants`, plan to remove the images of their variants too, where all cells of the store
    that use them are done, and no sweep is running.
    """
    done = [cell for cell in chosen if cell.state.name == "done"]
    left = len(chosen) - len(done)
    notes = [f"left alone, not done: {counted(left, 'cell')}"] if left else []
    items = []
    for cell in done:
        with suppress(OSError):
            if size := cell.folder.heavy_bytes():
                items.append(Item("cells", cell.name, size, cell.id, cell.folder.trim))
    if variants and any(cell.state.name == "running" for cell in cells):
        notes.append(_RUNNING)
    elif variants:
        needed = {cell.variant_id for cell in cells if cell.state.name != "done"}
        used = {cell.variant_id for cell in done if cell.variant_id is not None}
        if kept := used & needed:
            notes.append(
                f"left alone, with cells that are not done: {counted(len(kept), 'variant')}"
            )
        items += [
            Item("variants", name, size, None, partial(trimming.trim_variant, store.variants, name))
            for name in sorted(used - needed)
            if (size := trimming.image_bytes(store.variants, name))
        ]
    return Plan("trim", tuple(items), tuple(notes))


def plan_gc(store: Store, cells: Sequence[CellRow], of: Sequence[str]) -> Plan:
    """Plan to remove what no sweep of the installed code needs.

    A cell whose backend or component is not installed here is left alone: other machines need it.
    `of` has names of `GARBAGE`: cells of old code, failed cells and scenes, folders that were set
    aside, and variants without a cell. `cells` are all cells of the store.
    """
    for name in of:
        if name not in GARBAGE:
            raise XrgsError(f"of={name}: choose from: {', '.join(GARBAGE)}")
    idle, _ = _without_running(cells)
    stale = [cell for cell in idle if cell.stale] if "old_code" in of else []
    old = [cell for cell in stale if not cell.of_elsewhere]
    failed = [cell for cell in idle if cell.state.name == "failed"] if "failed" in of else []
    failed = [cell for cell in failed if cell not in old]
    gone = {cell.id for cell in (*old, *failed)}
    items = [*_removals(store, "cells of old code", old)]
    items += _removals(store, "failed cells", failed)
    if "failed" in of:
        scenes = [path for path in _paths(store.variants) if paths.is_failed(path.name)]
        items += _folders("failed scenes", scenes)
    if "aside" in of:
        for above in (store.cells_folder, store.variants):
            aside = [path for path in _paths(above) if _ASIDE.fullmatch(path.name)]
            leased = above == store.cells_folder
            items += _folders("folders that were set aside", aside, leased=leased)
    notes = _recorded([cell for cell in cells if cell.id in gone])
    if kept := len(stale) - len(old):
        notes.append(f"left alone, of a backend or component not installed here: {kept}")
    if "variants" in of:
        orphans, left_alone = _orphans(store, cells, gone)
        items += orphans
        notes += left_alone
    return Plan("remove", tuple(items), tuple(notes))


def carry_out(store: Store, plan: Plan) -> tuple[int, list[str]]:
    """Remove the items of a plan; one that can't be removed does not keep the others.

    Returns:
        The bytes that were freed, and a line for each item that was left, with the reason.
    """
    freed, left = 0, list[str]()
    for item in plan.items:
        try:
            with lease.held(store.leases, item.lease) if item.lease else nullcontext(True) as free:
                why = item.act() if free else "it is left: a sweep is training it"
        except OSError as error:
            why = f"{error.filename}: {error.strerror}"
        except StoreError as error:
            why = str(error)
        if why:
            left.append(for_line(f"{item.name}: {why}"))
        else:
            freed += item.bytes
    return freed, left


def _without_running(cells: Iterable[CellRow]) -> tuple[list[CellRow], list[str]]:
    """Return the cells that are not being trained, and a note of the others."""
    cells = list(cells)
    idle = [cell for cell in cells if cell.state.name != "running"]
    running = len(cells) - len(idle)
    return idle, [f"left alone, being trained: {counted(running, 'cell')}"] if running else []


def _recorded(cells: Sequence[CellRow]) -> list[str]:
    """Return a note on the sweeps whose reports lose numbers."""
    done = [cell for cell in cells if cell.state.name == "done" and cell.sweeps]
    if not done:
        return []
    sweeps = {sweep_id for cell in done for sweep_id in cell.sweeps}
    return [
        f"reports of {counted(len(sweeps), 'sweep')} lose the numbers of"
        f" {counted(len(done), 'done cell')}"
    ]


def _removals(store: Store, kind: str, cells: Iterable[CellRow]) -> Iterator[Item]:
    for cell in cells:
        act = partial(_remove_cell, store, cell)
        yield Item(kind, f"{cell.name}, {cell.state.name}", cell.bytes or 0, cell.id, act)


def _remove_cell(store: Store, cell: CellRow) -> str:
    """Remove a cell whose lease is held, unless its state has changed since the plan."""
    state = store.cell(cell.id).state(verify=False).name
    if state == "absent":
        return "it is no longer there"
    if state != cell.state.name:
        return f"it is left: it was {cell.state.name}, and is {state} now"
    remove_cell(cell.folder)
    return ""


def _paths(folder: Path) -> list[Path]:
    return [folder / name for name in list_folder(folder) if is_name(name)]


def _folders(kind: str, paths: Iterable[Path], *, leased: bool = False) -> Iterator[Item]:
    """Yield folders to remove; with `leased`, each under the lease that its name contains."""
    for folder in paths:
        match = _ASIDE.fullmatch(folder.name) if leased else None
        lease_name = (match["id"] or match["rest"]) if match else None
        name, size = f"{folder.parent.name}/{folder.name}", size_of(folder) or 0
        yield Item(kind, name, size, lease_name, partial(remove_path, folder))


def _orphans(
    store: Store, cells: Sequence[CellRow], gone: set[str]
) -> tuple[list[Item], list[str]]:
    """Return the variants without a cell, and notes on variants that are left alone."""
    # A running sweep has variants that none of its cells uses yet.
    if any(cell.state.name == "running" for cell in cells):
        return [], [_RUNNING]
    used = {cell.variant_id for cell in cells if cell.id not in gone}
    if None in used:
        return [], ["variants are left alone: the identity of a cell can't be read"]
    orphans, new = [], 0
    for path in _paths(store.variants):
        if not paths.is_variant(path.name) or paths.id_of(path.name) in used:
            continue
        is_new = time.time() - path.stat().st_mtime < _NEW_S
        new += is_new
        orphans += [] if is_new else [path]
    notes = [f"left alone, new and without a cell: {counted(new, 'variant')}"] if new else []
    return [*_folders("variants without a cell", orphans)], notes
