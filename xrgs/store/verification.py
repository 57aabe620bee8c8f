"""Hashes everything that a store keeps: cells, variants, rendered scenes and records of sweeps."""

from __future__ import annotations

import stat
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

from xrgs.errors import StoreError
from xrgs.mixture import paths, variant
from xrgs.photos import scenes
from xrgs.runtime.progress import ProgressBar
from xrgs.runtime.text import format_size
from xrgs.safeio.files import walk_files
from xrgs.safeio.records import list_folder
from xrgs.safeio.sanitize import for_line
from xrgs.store import trimming
from xrgs.store.store import Store, unchanged_record

_Checks = Iterator[tuple[Path, Callable[[], list[str]]]]


def verify(store: Store) -> tuple[str, list[str]]:
    """Hash every file of the finished cells, the frozen variants, the scenes and the records.

    Return lines for a terminal on the damage and the number of files, and a line for each file that
    is missing, damaged, changed, unreadable or not listed, which begins with its path.

    Raises:
        StoreError: There is no such store, or it can't be read now.
    """
    store.check_exists()
    start = time.perf_counter()
    damage: list[str] = []
    parts = list(_parts(store, damage))
    total = sum(size for _, size, _ in parts)
    with ProgressBar("hashing", "byte", total) as bar:
        for _, size, check in parts:
            damage += check()
            bar.update(size)
    seconds = time.perf_counter() - start
    lines = ["damaged, or can't be read:", *(f"  {line}" for line in damage)] if damage else []
    extent = f"{sum(files for files, *_ in parts):,} files, {format_size(total)}"
    result = f"{len(damage)} damaged" if damage else "all of them as they were written"
    lines.append(f"hashed: {extent}, in {seconds:.1f} s; {result}")
    return "\n".join(map(for_line, lines)), damage


def _parts(store: Store, damage: list[str]) -> Iterator[tuple[int, int, Callable[[], list[str]]]]:
    """Yield for each part of a store its number of regular files, their bytes and its check.

    Add a line to `damage` for each part that can't be listed.
    """
    for kind in (_cells, _variants, _scenes, _records):
        try:
            checks = list(kind(store))
        except StoreError as error:
            damage.append(str(error))
            continue
        for path, check in checks:
            try:
                statuses = [of for _, of in walk_files(path)] if path.is_dir() else [path.lstat()]
            except OSError as error:
                damage.append(f"{error.filename}: {error.strerror}")
                continue
            sizes = [of.st_size for of in statuses if stat.S_ISREG(of.st_mode)]
            yield len(sizes), sum(sizes), check


def _cells(store: Store) -> _Checks:
    for cell in store.cell_folders():
        state = cell.state(verify=False)
        if state.name == "done":
            yield cell.path, cell.verify
        elif state.name == "corrupt" or state.unreadable:
            yield cell.path, partial(list, [f"{cell.path}: {state.reason}"])


def _variants(store: Store) -> _Checks:
    for name in list_folder(store.variants):
        if paths.is_variant(name):
            folder = store.variants / name
            check = trimming.verify_variant if paths.is_trimmed(name) else variant.verify
            yield folder, partial(check, folder)


def _scenes(store: Store) -> _Checks:
    for name in list_folder(store.scenes):
        if not name.startswith("."):
            folder = store.scenes / name
            yield folder, partial(scenes.verify, folder)


def _records(store: Store) -> _Checks:
    for sweep_id in store.sweep_ids():
        file = store.sweeps / f"{sweep_id}.json"

        def check(file: Path = file) -> list[str]:
            try:
                unchanged_record(file)
            except StoreError as error:
                return [str(error)]
            return []

        yield file, check
