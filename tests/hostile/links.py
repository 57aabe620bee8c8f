"""Links, pipes, devices, sockets and folders in the place of a store's files and folders."""

from __future__ import annotations

import os
import shutil
import socket
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path

from tests.hostile.looks import Look, Maker, all_looks, cells, inspect, plan, report, rerun, status
from tests.hostile.reference import cell_of, sweep_file, variant_of

Kind = Callable[[Path], None]


def _pipe(path: Path) -> None:
    os.mkfifo(path)


def _socket(path: Path) -> None:
    here = Path.cwd()
    os.chdir(path.parent)  # the address of a socket is at most 108 bytes long
    try:
        with socket.socket(socket.AF_UNIX) as made:
            made.bind(path.name)
    finally:
        os.chdir(here)


def _link(target: str, path: Path) -> None:
    path.symlink_to(target)


def _loop(path: Path) -> None:
    path.symlink_to(path.name)


def _folder(path: Path) -> None:
    (path / "inner").mkdir(parents=True)


def _elsewhere(path: Path) -> None:
    """Link to a file outside the store."""
    store = next(folder for folder in (path, *path.parents) if folder.name == "store")
    path.symlink_to(store.with_name("OUTSIDE") / "victim.txt")


KINDS: Mapping[str, Kind] = {
    "pipe": _pipe,
    "socket": _socket,
    "dangling link": partial(_link, "/nonexistent/file"),
    "link to /dev/zero": partial(_link, "/dev/zero"),
    "link to /dev/stdin": partial(_link, "/dev/stdin"),
    "link to itself": _loop,
    "link to a file outside": _elsewhere,
    "folder": _folder,
}
#: Files of a cell that every cell has, and whether the cell is not done without them.
_CELL_FILES = {
    "status.json": False,
    "scores.csv": False,
    "history.csv": False,
    "identity.json": False,
    "config.json": False,
    "summary.json": False,
    "provenance.json": False,
    "splats.ply": False,
    "renders/view_1.png": False,
    "log.txt": True,
    "progress.json": True,
    "checkpoint.npz": True,
    "error.txt": True,
}


#: Those that commands fell for in ways of their own; the others differ in the first check alone.
_DISTINCT = {name: KINDS[name] for name in ("pipe", "link to a file outside", "link to /dev/zero")}


def _replace(path: Path, kind: Kind) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)
    kind(path)


def _cell_file(name: str, kind: Kind, store: Path) -> list[Look]:
    cell = cell_of(store)
    _replace(cell / name, kind)
    harmless = _CELL_FILES[name]
    planned = name == "status.json"
    if harmless:
        return all_looks(store, planned=planned)
    named = Path(name).name
    drawn = name in {"history.csv", "renders/view_1.png"}
    looks = all_looks(store, named, done=3, drawn=drawn, planned=planned)
    return [*looks, rerun(cell, named, can_train=True)] if kind is _pipe else looks


def _unfinished(name: str, kind: Kind, store: Path) -> list[Look]:
    """A cell that has no status, with one of the files that a running cell has."""
    cell = cell_of(store)
    (cell / "status.json").unlink()
    _replace(cell / name, kind)
    return [*all_looks(store, done=3), rerun(cell)]


def _variant_file(name: str, kind: Kind, store: Path) -> list[Look]:
    folder = variant_of(store)
    _replace(folder / name, kind)
    looks = [inspect(folder, Path(name).name), status(store), cells(store)]
    # A variant that is not intact is built anew, and its cells are trained anew on that.
    return [*looks, plan(store, done=None), report(store)]


def _added(part: str, kind: Kind, store: Path) -> list[Look]:
    kind(store / part)
    latest_is_hostile = part.startswith("sweeps/") and part.endswith(".json")
    looks = [status(store), cells(store), plan(store)]
    return [*looks, report(store, pair=not latest_is_hostile)]


def _folder_is(part: str, kind: Kind, store: Path) -> list[Look]:
    _replace(store / part, kind)
    healthy = {"cells": None, "sweeps": 4, "variants": 4, "locks": 4, "scenes": 4, "reports": 4}
    done = healthy[part]
    return [
        status(store, done=done),
        cells(store, done=done),
        report(store, part if part == "sweeps" else "", pair=part in {"locks", "scenes"}),
        plan(store, done=None),
    ]


def _outside(part: str, store: Path) -> list[Look]:
    """Move a part of the store out of it, and put a link in its place."""
    outside = store.with_name("OUTSIDE") / "moved"
    if (store / part).exists():
        (store / part).rename(outside)
    else:
        outside.mkdir()
    (store / part).parent.mkdir(parents=True, exist_ok=True)
    (store / part).symlink_to(outside)
    return all_looks(store, done=None, pair=False)


def _report_file(name: str, kind: Kind, store: Path) -> list[Look]:
    folder = store / "reports" / sweep_file(store).stem
    (folder / "figures").mkdir(parents=True)
    _replace(folder / name, kind)
    return [report(store, pair=False), status(store)]


def _link_to_usr(store: Path) -> list[Look]:
    (store / "extra").symlink_to("/usr")
    return all_looks(store)


def _store_is(kind: Kind, store: Path) -> list[Look]:
    shutil.rmtree(store)
    _replace(store, kind)
    return [*all_looks(store, done=None, pair=False), inspect(store), rerun(store)]


def _store_is_a_file(store: Path) -> list[Look]:
    shutil.rmtree(store)
    store.write_text("not a store\n")
    return [*all_looks(store, done=None, pair=False), inspect(store), rerun(store)]


def _cell_is(kind: Kind, store: Path) -> list[Look]:
    cell = cell_of(store)
    _replace(cell, kind)
    return [*all_looks(store, done=3), rerun(cell)]


def _hard_link(store: Path) -> list[Look]:
    """A report's file that is a hard link to a file outside."""
    folder = store / "reports" / sweep_file(store).stem
    folder.mkdir(parents=True)
    os.link(store.with_name("OUTSIDE") / "victim.txt", folder / "table.md")
    return [report(store)]


CASES: Mapping[str, Maker] = {
    **{
        f"{what} as {name}": partial(_cell_file, name, kind)
        for name in _CELL_FILES
        for what, kind in (KINDS if name == "status.json" else _DISTINCT).items()
    },
    **{
        f"{what} as {name} of an unfinished cell": partial(_unfinished, name, kind)
        for name in ("progress.json", "checkpoint.npz", "log.txt", "identity.json")
        for what, kind in _DISTINCT.items()
    },
    **{
        f"{what} as {name} of a variant": partial(_variant_file, name, kind)
        for name in ("variant.json", "points.npz", "report.json", "images/train/left.png", "images")
        for what, kind in (KINDS if name == "points.npz" else _DISTINCT).items()
    },
    **{
        f"{what} as {part}": partial(_added, part, kind)
        for part in (
            "sweeps/zz.json",
            "locks/x.0",
            "cells/0000000000000000",
            "variants/0000000000000000-0000000000000000",
            "variants/failed-0000000000000000",
        )
        for what, kind in KINDS.items()
    },
    **{
        f"{what} as {part}/": partial(_folder_is, part, kind)
        for part in ("cells", "sweeps", "variants", "locks", "scenes", "reports")
        for what, kind in _DISTINCT.items()
    },
    **{
        f"{part}/ outside": partial(_outside, part)
        for part in ("cells", "sweeps", "variants", "locks", "scenes", "reports", "hydra")
    },
    **{
        f"{what} as {name or 'folder'} of a report": partial(_report_file, name, kind)
        for name in ("table.md", "views.csv", "figures", "")
        for what, kind in _DISTINCT.items()
    },
    "a link to /usr": _link_to_usr,
    "a hard link in a report": _hard_link,
    **{f"{what} as the store": partial(_store_is, kind) for what, kind in KINDS.items()},
    "a file as the store": _store_is_a_file,
    **{f"{what} as a cell": partial(_cell_is, kind) for what, kind in KINDS.items()},
}
