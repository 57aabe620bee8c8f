"""The arguments of `xrgs-bench`, without torch, so that `--help` and mistakes answer at once."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass
class Settings:
    """What to measure, and where to write the results."""

    load: str | None = None
    """A .npz file to time instead of the random loads: Gaussians and a view, see `save`."""
    save: str | None = None
    """Write such a .npz file from `cell` and `view` instead of timing anything."""
    cell: str | None = None
    """Folder of a trained cell in its store, for `save` and `quality`."""
    view: str | None = None
    """Name of a training or test view of `cell`, for `save`."""
    out: str = "xrgs-bench"
    """Folder for bench.csv, shortcuts.csv and bench.png, or for against.csv."""
    json: str | None = None
    """File for all results as JSON."""
    repeats: int = 9
    """Number of times that each task is timed, in turn with those it is compared to."""
    threads: int = 0
    """Number of threads to time besides 1; 0 means one for each core."""
    smoke: bool = False
    """Use tiny loads, to check that everything runs."""
    against: str | None = None
    """Instead, time this installation and another in turn: the Python executable of the other."""
    quality: bool = False
    """Train `cell` again with each approximation changed and compare PSNR, instead of timing."""
    steps: int = 600
    """Number of training steps of each run of `quality`."""
    store_cells: int = 0
    """Instead, time planning, reporting and status over a store of this many cells."""
    seed: int = 0
    """Seed of the random loads."""
