"""Commands that look at a hostile store, and what their output must hold."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from tests.hostile.reference import SWEEP


@dataclass(frozen=True)
class Look:
    """One command on a store."""

    title: str
    command: str
    """The command's name without `xrgs-`; `cells` prints the table of `Store.cells`."""
    arguments: tuple[str, ...]
    names: tuple[str, ...] = ()
    """What the output must name: the file that is at fault."""
    shows: tuple[str, ...] = ()
    """What the output must hold of the healthy rest of the store."""
    succeeds: bool = False
    """Whether the command must end with 0: nothing that it reads is at fault."""
    hashed_gb: float = 0.0
    """Size of the files that the command is asked to hash, in units of 10^9 bytes."""
    can_train: bool = False
    """Whether the command trains a cell where it refuses nothing, which takes memory and time."""


Maker = Callable[[Path], list[Look]]
"""Makes a copy of the reference store hostile in place, and returns the looks at it."""


def status(store: Path, *names: str, done: int | None = 4) -> Look:
    """`xrgs-status`, which must count the healthy cells."""
    shows = () if done is None else (f"{done} done",)
    return Look("status", "status", (f"--store={store}",), names, shows, succeeds=done is not None)


def check(store: Path, *names: str) -> Look:
    """`xrgs-store check`, which hashes every file and names what is damaged."""
    return Look("check", "store", ("check", f"--store={store}"), names, ("hashed:",))


def report(store: Path, *names: str, pair: bool = True, drawn: bool = False) -> Look:
    """`xrgs-report`, which must show the comparison of the healthy pair of cells.

    Drawing takes most of the time of a report, so that only cases that change a picture draw.
    """
    shows = ("consistency against baseline",) if pair else ()
    arguments = (f"--store={store}", f"--pictures={'all' if drawn else 'none'}")
    return Look("report", "report", arguments, names, shows, succeeds=pair)


def inspect(folder: Path, *names: str, shows: tuple[str, ...] = ()) -> Look:
    """`xrgs-data inspect`; the sheet is written to the working folder."""
    return Look("inspect", "data", ("inspect", str(folder), "--out=sheet.png"), names, shows)


def rerun(cell: Path, *names: str, can_train: bool = False) -> Look:
    """`xrgs-sweep rerun=`."""
    return Look("rerun", "sweep", (f"rerun={cell}", "out=rerun"), names, can_train=can_train)


def plan(store: Path, *names: str, done: int | None = 4) -> Look:
    """`xrgs-sweep dry_run=true` of the sweep in the store, which must find the healthy cells."""
    shows = () if done is None else (f"plan: 4 cells, {done} done",)
    return Look("plan", "sweep", (*SWEEP, f"store={store}", "dry_run=true"), names, shows)


def cells(store: Path, *names: str, done: int | None = 4) -> Look:
    """`Store(store).cells()`, which must have the healthy cells."""
    shows = () if done is None else (f"{done} done",)
    return Look("cells", "cells", (str(store),), names, shows, succeeds=done is not None)


def all_looks(
    store: Path,
    *names: str,
    done: int | None = 4,
    pair: bool = True,
    drawn: bool = False,
    planned: bool = True,
) -> list[Look]:
    """Every command that reads a whole store.

    A plan takes most of the time of the four. It reads statuses, locks and variants, and hashes the
    files of cells; the cases that change what is in such a file alone leave it out.
    """
    looks = [
        status(store, *names, done=done),
        report(store, *names, pair=pair, drawn=drawn),
        cells(store, *names, done=done),
    ]
    return [*looks, plan(store, *names, done=done)] if planned else looks
