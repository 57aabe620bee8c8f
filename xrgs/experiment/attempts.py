"""Begins attempts at a cell, and removes cells: what changes which folder has a cell's name.

Each attempt at a cell has a folder of its own, which takes the place of the one before it. Its
process works in that very folder, whatever gets the name afterwards. What a kill leaves between two
attempts are folders `.<cell id>.old-*` and `.new-*`; the next attempt settles them.
"""

from __future__ import annotations

import errno
import secrets
import shutil
from contextlib import suppress
from typing import TYPE_CHECKING, Any

from xrgs.errors import StoreError, UnreadableError
from xrgs.experiment.cell_folder import CHECKPOINT, CellFolder
from xrgs.safeio.atomic import write_json
from xrgs.safeio.confined import ReplacedError
from xrgs.safeio.hashing import canonical_json

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from xrgs.safeio.confined import ConfinedPath

#: Files of a stopped attempt that the next one gets.
_KEPT_ON_RESUME = (CHECKPOINT, "log.txt")


def begin_attempt(
    cell: CellFolder, config: Mapping[str, Any], identity: Mapping[str, Any]
) -> CellFolder:
    """Begin an attempt at a cell: make a new folder with its config and identity alone.

    The checkpoint and the log of a stopped attempt at the same cell are copied into it. A folder
    that can't be resumed (another identity, or failed or corrupt without a checkpoint) is renamed
    to `<cell id>.aside-<n>`, so that it can be inspected.

    The caller holds the cell's lock. Each attempt has a folder of its own, so that a process that
    has lost the lock, and does not know it yet, writes into no folder but its own.

    Args:
        cell: The cell.
        config: The cell's config as plain JSON values.
        identity: The values that the cell's id is the digest of.

    Returns:
        The folder of this attempt. All that is done by it is an error (`ReplacedError`) once
        another attempt has begun; the folder of that attempt is never touched.

    Raises:
        UnreadableError: Nothing can be told of the folder now.
        ReplacedError: Another process has begun the cell at the same time.
    """
    folder = cell.folder
    folder.make_parent()
    before = folder.identity() if folder.exists() else None
    stopped = _stopped(cell, identity)
    new = _hidden(folder, "new")
    try:
        new.make_folder(exclusive=True)
        write_json(new / "config.json", config, durable=False)
        write_json(new / "identity.json", identity, durable=False)
        if stopped is not None:
            _copy(_KEPT_ON_RESUME, stopped.folder, new)
        new.sync_tree()
        attempt = CellFolder(new.pinned(name=folder.path))
        _set_aside(folder, before)
        new.rename(folder)
    except BaseException:
        _remove(new)
        raise
    folder.sync_name()
    _settle_leftovers(folder, identity)
    return attempt


def remove_cell(cell: CellFolder) -> None:
    """Remove a cell. The caller holds its lock.

    It loses its name first: what a kill leaves of it is no cell, and is removed with the next
    attempt or by `xrgs-store gc`.

    Args:
        cell: The cell.

    Raises:
        OSError: It can't be removed.
    """
    gone = _hidden(cell.folder, "new")
    cell.folder.rename(gone)
    gone.sync_name()
    gone.remove()


def _stopped(cell: CellFolder, identity: Mapping[str, Any]) -> CellFolder | None:
    """Return the attempt that a new one goes on from: the last, where it can be resumed.

    A process that was killed while it began an attempt may have left the last one hidden.
    """
    last = [cell] if cell.folder.exists() else _leftovers(cell.folder, "old")
    return next((attempt for attempt in last if _can_resume(attempt, identity)), None)


def _hidden(folder: ConfinedPath, kind: str) -> ConfinedPath:
    """Return a name that no folder has, for one that is made or replaced."""
    return folder.with_name(f".{folder.name}.{kind}-{secrets.token_hex(4)}")


def _leftovers(folder: ConfinedPath, kind: str) -> list[CellFolder]:
    """Return the hidden folders of one kind: the last attempt, or what nobody needs (`new`)."""
    prefix = f".{folder.name}.{kind}-"
    names = [name for name in folder.siblings() if name.startswith(prefix)]
    return [CellFolder(folder.with_name(name)) for name in names]


def _set_aside(folder: ConfinedPath, before: tuple[int, int] | None) -> None:
    """Free this name for a new attempt, unless another process has given it away meanwhile."""
    if before is None:
        return
    old = _hidden(folder, "old")
    folder.rename(old)
    if old.identity() != before:
        old.rename(folder)
        why = "another process has begun this cell at the same time"
        raise ReplacedError(errno.ESTALE, why, str(folder.path))
    # Otherwise a power failure could keep the new folder's name and lose this one.
    old.sync_name()


def _settle_leftovers(folder: ConfinedPath, identity: Mapping[str, Any]) -> None:
    """Remove stopped attempts, which the new one goes on from; keep every other one aside."""
    for old in _leftovers(folder, "old"):
        stopped = _can_resume(old, identity)
        name = _hidden(folder, "new") if stopped else _free_name(folder)
        old.folder.rename(name)
        # What a power failure leaves of a removal must not pass for an attempt.
        name.sync_name()
    for new in _leftovers(folder, "new"):
        _remove(new.folder)


def _can_resume(attempt: CellFolder, identity: Mapping[str, Any]) -> bool:
    state = attempt.state()
    if state.name == "unknown":
        raise UnreadableError(f"{attempt.path}: {state.reason}")
    failed_late = state.name == "failed" and attempt.checkpoint.is_file()
    if state.name != "unfinished" and not failed_late:
        return False
    try:
        return canonical_json(attempt.identity()) == canonical_json(identity)
    except UnreadableError:
        raise
    except (StoreError, TypeError, ValueError):
        return False


def _copy(names: Iterable[str], source: ConfinedPath, target: ConfinedPath) -> None:
    """Copy the files that are there.

    They are not moved: until the new attempt is in place, the old one must be whole, and its
    process may have the log open.
    """
    for name in names:
        if (source / name).is_file():
            with (source / name).open() as stream, (target / name).create() as copy:
                shutil.copyfileobj(stream, copy)


def _remove(folder: ConfinedPath) -> None:
    """Remove a folder that no process needs any more.

    One that is still written to, by a process that has lost its lock, may resist: the next attempt
    tries again.
    """
    with suppress(OSError):
        folder.remove()


def _free_name(path: ConfinedPath) -> ConfinedPath:
    """Return the first sibling that does not exist: `<name>.aside-1`, `<name>.aside-2`, ..."""
    number = 1
    while (free := path.with_name(f"{path.name}.aside-{number}")).exists():
        number += 1
    return free
