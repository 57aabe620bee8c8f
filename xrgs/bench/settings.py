"""The arguments of `xrgs-bench`, in a module without torch, so that `--help` is quick."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass
class Settings:
    """The measurements and the output files."""

    load: str | None = None
    """Measure the Gaussians and the view in this .npz file instead of random ones (see `save`)."""
    save: str | None = None
    """Only write a .npz file with the Gaussians and a view of `cell`, without a benchmark."""
    cell: str | None = None
    """Folder of a trained cell in its store, for `save`."""
    view: str | None = None
    """Name of a training or test view of `cell`, for `save`."""
    out: str = "xrgs-bench"
    """Folder of the .csv files and of bench.png."""
    json: str | None = None
    """Also write all results to this JSON file."""
    repeats: int = 9
    """Number of timed runs of each task; tasks that are compared take turns."""
    threads: int = 0
    """Number of threads to measure besides 1; 0 means one for each core."""
    smoke: bool = False
    """Use tiny loads, to check that everything runs."""
    against: str | None = None
    """Python executable of another installation, to time both in turn."""
    seed: int = 0
    """Seed of the random loads."""
