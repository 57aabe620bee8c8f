"""Files and folders that may not be read. The commands run without root's right to read them."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path

from tests.hostile.looks import Look, Maker, all_looks, cells, inspect, plan, report, rerun, status
from tests.hostile.reference import cell_of, sweep_file, variant_of


def _cell(store: Path) -> list[Look]:
    cell_of(store).chmod(0)
    return [*all_looks(store, done=3), rerun(cell_of(store))]


def _cell_file(name: str, store: Path) -> list[Look]:
    cell = cell_of(store)
    (cell / name).chmod(0)
    hashed = [report(store, name), cells(store, name, done=3), plan(store, name, done=3)]
    sized = status(store, name, done=3) if name == "status.json" else status(store)
    return [sized, *hashed, rerun(cell, name)]


def _part(part: str, mode: int, store: Path) -> list[Look]:
    (store / part).chmod(mode)
    if part == "cells":
        return all_looks(store, done=None, pair=False)
    if part == "sweeps":
        return [status(store), cells(store), plan(store), report(store, part, pair=False)]
    return [status(store), cells(store), plan(store, done=None), report(store)]


def _sweep(store: Path) -> list[Look]:
    file = sweep_file(store)
    file.chmod(0)
    return [*all_looks(store, pair=False)[:1], report(store, file.name, pair=False), cells(store)]


def _variant(store: Path) -> list[Look]:
    folder = variant_of(store)
    folder.chmod(0)
    return [inspect(folder), *all_looks(store, done=None)]


def _variant_file(name: str, store: Path) -> list[Look]:
    folder = variant_of(store)
    (folder / name).chmod(0)
    return [inspect(folder, Path(name).name), *all_looks(store, done=None)]


def _reports(store: Path) -> list[Look]:
    (store / "reports").mkdir(mode=0)
    return [report(store, "reports", pair=False), status(store), cells(store)]


def _read_only(store: Path) -> list[Look]:
    store.chmod(0o555)
    return [status(store), cells(store), report(store, "reports", pair=False)]


def _store(store: Path) -> list[Look]:
    store.chmod(0)
    return all_looks(store, str(store), done=None, pair=False)


CASES: Mapping[str, Maker] = {
    "a cell": _cell,
    **{
        f"{name} of a cell": partial(_cell_file, name)
        for name in ("status.json", "scores.csv", "history.csv", "identity.json")
    },
    **{f"{part}/": partial(_part, part, 0) for part in ("cells", "sweeps", "variants", "locks")},
    **{f"{p}/ listed only": partial(_part, p, 0o444) for p in ("cells", "sweeps", "variants")},
    **{f"{p}/ entered only": partial(_part, p, 0o111) for p in ("cells", "sweeps", "variants")},
    "a sweep": _sweep,
    "a variant": _variant,
    **{
        f"{name} of a variant": partial(_variant_file, name)
        for name in ("variant.json", "points.npz", "images/train/left.png", "images")
    },
    "reports/": _reports,
    "a store that is read-only": _read_only,
    "the store": _store,
}
