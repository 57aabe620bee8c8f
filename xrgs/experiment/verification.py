"""Hashes everything that a store keeps: cells, variants, rendered scenes and records of sweeps."""

from __future__ import annotations

import stat
import time
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

from xrgs.capture import scenes, variant
from xrgs.capture.failures import FAILED_PREFIX
from xrgs.errors import StoreError
from xrgs.runtime.progress import ProgressBar
from xrgs.safeio.records import list_folder

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from xrgs.experiment.store import Store
    from xrgs.safeio.confined import ConfinedPath

    _Checks = Iterator[tuple[ConfinedPath, Callable[[], list[str]]]]


@dataclass(frozen=True)
class Verification:
    """What was hashed, and what is wrong with it."""

    files: int
    bytes: int
    seconds: float
    damage: tuple[str, ...]
    """A line for each file that is missing, has changed, can't be read now or does not belong where
    it is; the line begins with its path."""


@dataclass(frozen=True)
class _Part:
    """A file or a folder that is verified as one: a cell, a variant, a scene or a record."""

    path: ConfinedPath
    files: int
    bytes: int
    verify: Callable[[], list[str]]


def verify(store: Store) -> Verification:
    """Hash every file of the finished cells, the frozen variants, the scenes and the records.

    Args:
        store: The store; nothing is written to it.

    Returns:
        What was hashed, and what is wrong.
    """
    start = time.perf_counter()
    damage: list[str] = []
    parts = list(_parts(store, damage))
    total = sum(part.bytes for part in parts)
    with ProgressBar("hashing", "byte", total) as bar:
        for part in parts:
            damage += part.verify()
            bar.update(part.bytes)
    seconds = time.perf_counter() - start
    return Verification(sum(part.files for part in parts), total, seconds, tuple(damage))


def _parts(store: Store, damage: list[str]) -> Iterator[_Part]:
    """Yield what is to be verified; add to `damage` what can't be looked at."""
    for kind in (_cells, _variants, _scenes, _records):
        try:
            checks = list(kind(store))
        except StoreError as error:
            damage.append(str(error))
            continue
        for path, check in checks:
            try:
                files, size = _extent(path)
            except OSError as error:
                damage.append(f"{error.filename}: {error.strerror}")
                continue
            yield _Part(path, files, size, check)


def _cells(store: Store) -> _Checks:
    for cell in store.cell_folders():
        if cell.state(verify=False).name == "done":
            yield cell.folder, cell.verify


def _variants(store: Store) -> _Checks:
    for name in list_folder(store.variants):
        if not name.startswith((".", FAILED_PREFIX)):
            folder = store.variants / name
            yield folder, partial(variant.verify, folder)


def _scenes(store: Store) -> _Checks:
    for name in list_folder(store.scenes):
        if not name.startswith("."):
            folder = store.scenes / name
            yield folder, partial(scenes.verify, folder)


def _records(store: Store) -> _Checks:
    for sweep_id in store.sweep_ids():
        yield store.sweeps / f"{sweep_id}.json", partial(_record, store, sweep_id)


def _record(store: Store, sweep_id: str) -> list[str]:
    try:
        store.verify_sweep(sweep_id)
    except StoreError as error:
        return [str(error)]
    return []


def _extent(path: ConfinedPath) -> tuple[int, int]:
    """Return the number of regular files at a path or below, and their bytes."""
    found = [status for _, status in path.walk()] if path.is_dir() else [path.lstat()]
    sizes = [status.st_size for status in found if stat.S_ISREG(status.st_mode)]
    return len(sizes), sum(sizes)
