"""The arguments of `xrgs-bench`, in a module without torch, so that `--help` is quick."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from xrgs.composing import INT64_LIMIT


@dataclass
class Settings:
    """The measurements and the output files."""

    load: Path | None = None
    """Measure the Gaussians and the view in this .npz file instead of random ones (see `save`)."""
    save: Path | None = None
    """Only write a .npz file with the Gaussians and a view of `cell`, without a benchmark."""
    cell: Path | None = None
    """Folder of a trained cell in its store, for `save`."""
    view: str | None = None
    """Name of a training or test view of `cell`, for `save`."""
    out: Path = Path("xrgs-bench")
    """Folder of the .csv files and of bench.png."""
    json: Path | None = None
    """Also write all results to this JSON file."""
    repeats: int = field(default=9, metadata={"least": 1})
    """Number of timed runs of each task; tasks that are compared take turns."""
    threads: int = field(default=0, metadata={"least": 0})
    """Number of threads to measure besides 1; 0 means one for each core."""
    smoke: bool = False
    """Use tiny loads, to check that everything runs."""
    against: Path | None = None
    """Python executable of another installation, to time both in turn."""
    seed: int = field(default=0, metadata={"least": 0, "below": INT64_LIMIT})
    """Seed of the random loads."""
