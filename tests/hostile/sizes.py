"""Files of 2 GB that take no disk, and files that declare sizes they don't have."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path

from tests.hostile.looks import Look, Maker, all_looks, check, inspect, plan, report, rerun, status
from tests.hostile.reference import all_cells, cell_of, edit, sweep_file, variant_of

_SIZE = 2 << 30


def grow(file: Path, size: int = _SIZE) -> None:
    """Make a file larger by a hole."""
    with file.open("ab"):
        os.truncate(file, size)


#: The files of a cell that are verified by their hash.
_HASHED = (
    *("scores.csv", "history.csv", "quality.csv"),
    *("summary.json", "identity.json", "config.json"),
)


def _cell_file(name: str, store: Path) -> list[Look]:
    cell = cell_of(store)
    grow(cell / name)
    return all_looks(store, name, done=3, planned=name == "status.json")


def _declared(name: str, store: Path) -> list[Look]:
    """The status lists the size that the file has, so that its hash is wanted."""
    cell = cell_of(store)
    grow(cell / name)
    edit(cell / "status.json", lambda d: d["files"][name].update(bytes=_SIZE))
    hashed = name in _HASHED
    named, done = (name, 3) if hashed else ("", None)
    verified = replace(check(store, named), succeeds=False, hashed_gb=_SIZE / 1e9)
    return [report(store, named), verified, plan(store, done=done)]


def _not_listed(name: str, store: Path) -> list[Look]:
    cell = cell_of(store)
    grow(cell / name)
    return all_looks(store)


def _unfinished(name: str, store: Path) -> list[Look]:
    cell = cell_of(store)
    (cell / "status.json").unlink()
    grow(cell / name)
    return all_looks(store, done=3)


def _sweep(store: Path) -> list[Look]:
    grow(sweep_file(store))
    return all_looks(store, pair=False, planned=False)


def _lock(store: Path) -> list[Look]:
    cell = cell_of(store)
    (cell / "status.json").unlink()
    grow(store / "locks" / f"{cell.name}.0")
    return all_looks(store, done=3)


def _variant_file(name: str, store: Path) -> list[Look]:
    folder = variant_of(store)
    grow(folder / name)
    return [inspect(folder, Path(name).name), *all_looks(store, done=None)]


def _failed_scene(store: Path) -> list[Look]:
    folder = store / "variants" / "failed-0123456789abcdef"
    folder.mkdir()
    grow(folder / "report.json")
    return [*all_looks(store), inspect(folder, "report.json")]


def _report_file(store: Path) -> list[Look]:
    folder = store / "reports" / sweep_file(store).stem
    folder.mkdir(parents=True)
    grow(folder / "table.md")
    return [status(store), report(store)]


def _many_files(store: Path) -> list[Look]:
    """A status that lists 200,000 files."""
    names = {f"f{number}": {"bytes": 0, "sha256": ""} for number in range(200_000)}
    edit(cell_of(store) / "status.json", lambda d: d["files"].update(names))
    return all_looks(store, done=3)


def _one_file_often(store: Path) -> list[Look]:
    """A status that lists 100,000 names of one file."""
    size = (cell_of(store) / "scores.csv").stat().st_size
    names = {"renders/" * n + "x": {"bytes": size, "sha256": ""} for n in range(1, 400)}
    edit(cell_of(store) / "status.json", lambda d: d["files"].update(names))
    return all_looks(store, done=3)


def _many_cells(store: Path) -> list[Look]:
    for number in range(2000):
        (store / "cells" / f"{number:016x}").mkdir()
    return all_looks(store)


def _many_locks(store: Path) -> list[Look]:
    for number in range(2000):
        (store / "locks" / f"{number:016x}.0").write_text("{}")
    return all_looks(store)


def _long_history(store: Path) -> list[Look]:
    for cell in all_cells(store)[:1]:
        header, row = (cell / "history.csv").read_text().splitlines()[:2]
        (cell / "history.csv").write_text("\n".join([header, *[row] * 200_000]) + "\n")
        size = (cell / "history.csv").stat().st_size
        edit(cell / "status.json", lambda d, s=size: d["files"]["history.csv"].update(bytes=s))  # type: ignore[misc]
    return all_looks(store, done=None, pair=False)


def _identity_of_many(store: Path) -> list[Look]:
    cell = cell_of(store)
    code = {f"f{number}.py": "0" for number in range(100_000)}
    text = json.loads((cell / "identity.json").read_text()) | {"code": code}
    (cell / "identity.json").write_text(json.dumps(text))
    from tests.hostile.reference import seal

    seal(cell)
    return [*all_looks(store), rerun(cell, can_train=True)]


_LISTED = (
    *_HASHED,
    *("provenance.json", "splats.ply", "renders/view_1.png"),
)
CASES: Mapping[str, Maker] = {
    **{f"{name} of 2 GB": partial(_cell_file, name) for name in ("status.json", *_LISTED)},
    **{f"{name} of 2 GB, as listed": partial(_declared, name) for name in _LISTED},
    **{f"{name} of 2 GB": partial(_not_listed, name) for name in ("log.txt", "error.txt")},
    **{
        f"{name} of 2 GB, unfinished": partial(_unfinished, name)
        for name in ("progress.json", "checkpoint.npz")
    },
    "a sweep of 2 GB": _sweep,
    "a lock of 2 GB": _lock,
    **{
        f"{name} of a variant of 2 GB": partial(_variant_file, name)
        for name in ("variant.json", "points.npz", "report.json", "images/train/left.png")
    },
    "a failed scene of 2 GB": _failed_scene,
    "a report of 2 GB": _report_file,
    "a status of 200,000 files": _many_files,
    "a status of 400 deep files": _one_file_often,
    "2,000 empty cells": _many_cells,
    "2,000 empty locks": _many_locks,
    "a history of 200,000 rows": _long_history,
    "an identity of 100,000 files": _identity_of_many,
}
