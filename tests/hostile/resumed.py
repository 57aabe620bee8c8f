"""Sweeps that train the one cell that is missing, in a store that somebody prepared for that."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path

from tests.hostile.links import KINDS, Kind
from tests.hostile.looks import Look, Maker
from tests.hostile.reference import SWEEP, cell_of


def _sweep(store: Path) -> list[Look]:
    arguments = (*SWEEP, f"store={store}", "threads=1")
    shows = ("consistency against baseline",)
    return [Look("train", "sweep", arguments, shows=shows, can_train=True)]


def _unfinished(store: Path) -> Path:
    cell = cell_of(store)
    kept = {"config.json", "identity.json", "log.txt"}
    for file in cell.iterdir():
        if file.is_file() and file.name not in kept:
            file.unlink()
    return cell


def _cell_file(name: str, kind: Kind, store: Path) -> list[Look]:
    file = _unfinished(store) / name
    file.unlink(missing_ok=True)
    kind(file)
    return _sweep(store)


def _renders_outside(store: Path) -> list[Look]:
    folder = _unfinished(store) / "renders"
    for file in folder.iterdir():
        file.unlink()
    folder.rmdir()
    folder.symlink_to(store.with_name("OUTSIDE"))
    return _sweep(store)


def _cell_outside(store: Path) -> list[Look]:
    cell = _unfinished(store)
    outside = store.with_name("OUTSIDE") / "cell"
    cell.rename(outside)
    cell.symlink_to(outside)
    return _sweep(store)


CASES: Mapping[str, Maker] = {
    **{
        f"{what} as {name}": partial(_cell_file, name, KINDS[what])
        for name in ("log.txt", "checkpoint.npz", "progress.json")
        for what in ("pipe", "link to a file outside")
    },
    "renders/ outside": _renders_outside,
    "the cell outside": _cell_outside,
}
