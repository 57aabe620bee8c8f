"""The arguments of `xrgs-bench`. Without torch, so that `--help` and mistakes answer at once."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass
class Settings:
    """What to time, and where to leave what was measured."""

    load: str | None = None
    """A .npz to time in place of the random loads."""
    save: str | None = None
    """Make such a file instead of timing anything, from `cell` and `view`."""
    cell: str | None = None
    """Folder of a trained cell, in its store: of `save` and `quality`."""
    view: str | None = None
    """Name of one of its views, trained on or held out."""
    out: str = "xrgs-bench"
    """Folder of bench.csv and bench.png."""
    json: str | None = None
    """File for every figure, for a program to read."""
    repeats: int = 9
    """Times that each thing is timed, in turn with what it is compared to."""
    threads: int = 0
    """Beside 1; 0 takes every core."""
    smoke: bool = False
    """Tiny loads: does everything run?"""
    quality: bool = False
    """Train `cell` again with each cut changed and compare pictures, instead of timing."""
    steps: int = 600
    """Of `quality`."""
    store_cells: int = 0
    """Time planning, reporting and status over a store of so many cells, instead."""
    seed: int = 0
    """Of the random loads."""
