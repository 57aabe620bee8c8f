"""Folders that are made once, list the hashes of their files, and are verified before each use."""

from __future__ import annotations

import itertools
from collections.abc import Collection, Iterable, Iterator, Mapping
from pathlib import Path

from xrgs.errors import StoreError, UnreadableError
from xrgs.safeio.files import is_transient, walk_files
from xrgs.safeio.hashing import file_digest


def hashes(folder: Path, names: Iterable[str]) -> dict[str, str]:
    """Return the SHA-256 of files of a folder by their paths in it."""
    return {name: file_digest(folder / name) for name in names}


def changed(
    folder: Path, files: Mapping[str, str], since: str = "it was written"
) -> Iterator[StoreError]:
    """Yield an error for each file of a folder that is missing or has changed.

    `files` has the SHA-256 that each must have, by its path in the folder, with `/`. The error is
    an `UnreadableError` for a file that can't be read now.
    """
    for name, expected in files.items():
        file = folder / name
        try:
            if file_digest(file) != expected:
                yield StoreError(f"{file}: it has changed since {since}")
        except OSError as error:
            kind = UnreadableError if is_transient(error) else StoreError
            yield kind(f"{file}: {error.strerror}")


def unlisted(folder: Path, names: Collection[str]) -> Iterator[StoreError]:
    """Yield an error for each file of a folder that is not among `names`, paths with `/`."""
    try:
        for name, _ in walk_files(folder):
            if name not in names:
                yield StoreError(f"{folder}/{name}: it does not belong there")
    except OSError as error:
        kind = UnreadableError if is_transient(error) else StoreError
        yield kind(f"{error.filename}: {error.strerror}")


def set_aside(folder: Path) -> Path:
    """Rename a damaged folder to `.<name>.aside-<number>`, so that another can take its place."""
    names = (f".{folder.name}.aside-{number}" for number in itertools.count(1))
    return folder.rename(next(path for path in map(folder.with_name, names) if not path.exists()))
