"""Plans and begins attempts at a cell, and removes cells: each changes which folder has its name.

A sweep first writes a cell's config and identity (`plan_cell`). Each attempt at the cell then gets
a folder of its own, which takes the place of the one before. The process of an attempt works in
that very folder, because the folder is its working directory, whatever folder gets the name
afterwards. A kill between two attempts leaves folders `.<cell id>.old-*` and `.new-*`, which the
next attempt settles.
"""

from __future__ import annotations

import secrets
import shutil
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict
from itertools import count
from pathlib import Path

import msgspec

from xrgs.config import Conf
from xrgs.errors import UnreadableError
from xrgs.safeio.atomic import write_json
from xrgs.safeio.files import list_names, remove_path, sync_name, sync_tree
from xrgs.store.cell_folder import CONFIG, IDENTITY, LOG, CellFolder
from xrgs.store.schema import Identity


def plan_cell(cell: CellFolder, conf: Conf, identity: Identity) -> None:
    """Write the config and the identity of a cell that no process is training.

    Files of an earlier attempt stay until the next one begins.
    """
    cell.path.mkdir(exist_ok=True)
    # Not durable: when the power goes, the sweep that has planned the cell is over.
    write_json(cell.path / CONFIG, asdict(conf), durable=False)
    write_json(cell.path / IDENTITY, msgspec.to_builtins(identity), durable=False)


def begin_attempt(cell: CellFolder, is_owner: Callable[[], bool] = lambda: True) -> bool:
    """Begin an attempt at a planned cell: put a new folder in the place of the cell's folder.

    The new folder has the config and the identity of the old one, and the checkpoint and the log of
    a stopped attempt. A folder that can't be resumed (failed without a checkpoint, or corrupt) is
    renamed to `<cell id>.aside-<n>`, so that it can be inspected.

    The caller holds the cell's lease. Right before the folder is replaced, `is_owner` is asked
    whether it still does; if not, False is returned and nothing has changed. UnreadableError says
    that a file can't be read now.
    """
    folder = cell.path
    stopped = _stopped(cell)
    new, old = _hidden(folder, "new"), _hidden(folder, "old")
    try:
        new.mkdir()
        files = [folder / CONFIG, folder / IDENTITY]
        files += [stopped.checkpoint, stopped.path / LOG] if stopped else []
        for file in files:
            # Not moved: until the new attempt is in place the old one must be whole, and its
            # process may have the log open.
            if file.is_file():
                shutil.copyfile(file, new / file.name)
        (new / LOG).touch()  # from now on the cell has begun
        sync_tree(new)
        if not is_owner():
            remove_path(new)
            return False
        folder.rename(old)
        # Otherwise a power failure could keep the new folder's name and lose this one.
        sync_name(old)
        new.rename(folder)
    except BaseException:
        _remove(new)
        raise
    sync_name(folder)
    _settle_leftovers(folder)
    return True


def remove_cell(cell: CellFolder) -> None:
    """Remove a cell, whose lease the caller holds.

    The folder is renamed first. If a kill leaves a part of it, that part is no cell: the next
    attempt or `xrgs-store gc` removes it.
    """
    renamed = _hidden(cell.path, "new")
    cell.path.rename(renamed)
    sync_name(renamed)
    remove_path(renamed)


def _stopped(cell: CellFolder) -> CellFolder | None:
    """Return the attempt that a new one resumes: the last one, where it can be resumed.

    A process that was killed while it began an attempt may have left the last one hidden.
    """
    begun = (cell.path / LOG).exists() or cell.status_file.exists()
    last = [cell] if begun else _leftovers(cell.path, "old")
    return next((attempt for attempt in last if _can_resume(attempt)), None)


def _can_resume(attempt: CellFolder) -> bool:
    state = attempt.state()
    if state.unreadable:
        raise UnreadableError(f"{attempt.path}: {state.reason}")
    failed_late = state.name == "failed" and attempt.checkpoint.is_file()
    return state.name in {"planned", "unfinished"} or failed_late


def _hidden(folder: Path, kind: str) -> Path:
    """Return an unused hidden name beside a cell's folder, for a folder of one kind."""
    return folder.with_name(f".{folder.name}.{kind}-{secrets.token_hex(4)}")


def _leftovers(folder: Path, kind: str) -> list[CellFolder]:
    """Return a cell's hidden folders of one kind: attempts (`old`), or rubbish (`new`)."""
    prefix = f".{folder.name}.{kind}-"
    names = [name for name in list_names(folder.parent) if name.startswith(prefix)]
    return [CellFolder(folder.with_name(name)) for name in names]


def _settle_leftovers(folder: Path) -> None:
    """Remove stopped attempts, which the new one resumes; keep every other one aside."""
    for old in _leftovers(folder, "old"):
        name = _hidden(folder, "new") if _can_resume(old) else free_name(folder, "aside")
        old.path.rename(name)
        # After a power failure, a folder that was half removed must not pass for an attempt.
        sync_name(name)
    for new in _leftovers(folder, "new"):
        _remove(new.path)


def _remove(folder: Path) -> None:
    """Remove a folder that no process needs any more.

    The folder of a process that has lost its lease, and still writes, may resist: the next attempt
    tries again.
    """
    with suppress(OSError):
        remove_path(folder)


def free_name(path: Path, kind: str) -> Path:
    """Return the first sibling that does not exist: `<name>.<kind>-1`, `<name>.<kind>-2`, ..."""
    names = (path.with_name(f"{path.name}.{kind}-{number}") for number in count(1))
    return next(name for name in names if not name.exists())
