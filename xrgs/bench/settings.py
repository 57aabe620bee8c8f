"""The arguments of `xrgs-bench`. This module needs no torch, so that `--help` answers at once."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass
class Settings:
    """What to measure, and where to write the results."""

    load: str | None = None
    """Measure the Gaussians and the view in this .npz file instead of random ones (see `save`)."""
    save: str | None = None
    """Write a .npz file with the Gaussians of `cell` and one view of it, and measure nothing."""
    cell: str | None = None
    """Folder of a trained cell in its store, for `save`."""
    view: str | None = None
    """Name of a training or test view of `cell`, for `save`."""
    out: str = "xrgs-bench"
    """Folder of the .csv files and of bench.png."""
    json: str | None = None
    """Also write all results to this JSON file."""
    repeats: int = 9
    """How often each task is timed; tasks that are compared take turns."""
    threads: int = 0
    """Number of threads to measure besides 1; 0 means one for each core."""
    smoke: bool = False
    """Use tiny loads, to check that everything runs."""
    against: str | None = None
    """Time this installation and another in turn; the Python executable of the other."""
    seed: int = 0
    """Seed of the random loads."""
