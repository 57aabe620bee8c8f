"""Folders that are made once, list the hashes of their files, and are verified before each use.

The hashes tell what a disk, a program or a hand has changed by accident. They can't tell who wrote
a folder: whoever writes all of it can write hashes that fit.
"""

from __future__ import annotations

import fcntl
import itertools
import logging
from contextlib import contextmanager
from typing import TYPE_CHECKING

from xrgs.errors import StoreError, UnreadableError
from xrgs.safeio.confined import is_passing
from xrgs.safeio.hashing import file_digest

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Iterator, Mapping

    from xrgs.safeio.confined import ConfinedPath

_log = logging.getLogger(__name__)

#: The largest file that is hashed: an image takes at most 201 MB, and 40 million points 1 GB.
_MAX_BYTES = 1 << 30


def hashes(folder: ConfinedPath, names: Iterable[str]) -> dict[str, str]:
    """Hash files of a folder.

    Args:
        folder: The folder.
        names: Paths in it, with `/`.

    Returns:
        The SHA-256 of each file by its name.

    Raises:
        OSError: A file can't be read.
    """
    return {name: file_digest(folder / name) for name in names}


def changed(folder: ConfinedPath, files: Mapping[str, str]) -> Iterator[StoreError]:
    """Yield what is wrong with the files of a folder.

    Args:
        folder: The folder, which may come from anybody.
        files: The SHA-256 that each file must have, by its path in the folder, with `/`.

    Yields:
        An error for each file that is missing or has changed; an `UnreadableError` for one that
        can't be read now, of whose content nothing is known.
    """
    for name, expected in files.items():
        file = folder / name
        try:
            if file.lstat().st_size > _MAX_BYTES:
                yield StoreError(f"{file}: it is larger than {_MAX_BYTES} bytes")
            elif file_digest(file) != expected:
                yield StoreError(f"{file}: it has changed since it was written")
        except OSError as error:
            if is_passing(error):
                yield UnreadableError(f"{file}: {error.strerror}")
            else:
                yield StoreError(f"{file}: {error.strerror}")


def unlisted(folder: ConfinedPath, names: Collection[str]) -> Iterator[StoreError]:
    """Yield an error for each file of a folder that no list has.

    Args:
        folder: The folder, which may come from anybody.
        names: The files that it may hold: paths in it, with `/`.

    Yields:
        The errors; an `UnreadableError` where a folder can't be read now.
    """
    try:
        for name, _ in folder.walk():
            if name not in names:
                yield StoreError(f"{folder}/{name}: it does not belong there")
    except OSError as error:
        yield (UnreadableError if is_passing(error) else StoreError)(
            f"{error.filename}: {error.strerror}"
        )


def own_name(folder: ConfinedPath) -> str:
    """Return the name that a folder has on the disk, where a user named it by a link or by `.`.

    Args:
        folder: The folder.
    """
    return folder.name if folder.parts else folder.root.resolve().name


def set_aside(folder: ConfinedPath) -> ConfinedPath:
    """Rename a damaged folder to `.<its name>.aside-<number>`, so that another can take its place.

    Args:
        folder: The folder.

    Returns:
        The new path.

    Raises:
        OSError: It can't be renamed.
    """
    names = (f".{folder.name}.aside-{number}" for number in itertools.count(1))
    target = next(path for path in map(folder.with_name, names) if not path.exists())
    folder.rename(target)
    return target


@contextmanager
def lock(file: ConfinedPath) -> Iterator[None]:
    """Hold an exclusive lock while a folder is made.

    The system releases it where this process dies.

    Args:
        file: The lock's file, which is made where it is missing, and stays.
    """
    with file.append() as handle:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            _log.warning("%s: another process holds it: waiting until it has finished", file)
            fcntl.flock(handle, fcntl.LOCK_EX)
        yield
