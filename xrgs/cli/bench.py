"""`xrgs-bench`: measures the run time, error and memory of the rasterizers, and of a store."""

from __future__ import annotations

from typing import cast

from omegaconf import OmegaConf

from xrgs.bench.settings import Settings
from xrgs.cli.arguments import errors_as_messages, parse
from xrgs.runtime.machine import set_passive_openmp_wait
from xrgs.runtime.streams import say

_HELP = """\
xrgs-bench [KEY=VALUE]...

Measures the run time of rendering and training on random loads, against their numerical error.
With store_cells=N it measures planning, reporting and the cost of a job over a store of N cells.

  repeats=9        times that each thing is measured, in turn with what it is compared to
  threads=0        number of threads to measure beside 1; 0 for every core
  seed=0           seed of the random loads
  smoke=true       use tiny loads, to see whether everything runs
  out=FOLDER       folder of the .csv files and bench.png; xrgs-bench by default
  json=FILE        also write every figure to a JSON file

  load=FILE.npz    measure this load instead of the random ones
  against=PYTHON   render and train with this installation and another in turn, the one of the
                   environment of that Python executable; into against.csv
  save=FILE.npz cell=FOLDER view=NAME
                   make such a load from a view of a trained cell, and measure nothing
  quality=true cell=FOLDER steps=600
                   train the cell again with each culling option changed, and compare renders
  store_cells=N    measure planning, reporting and status over a store of N cells
"""


def main() -> None:
    """Run `xrgs-bench [KEY=VALUE]...`."""
    set_passive_openmp_wait()  # as in training
    with errors_as_messages("xrgs-bench"):
        settings = OmegaConf.to_object(parse(Settings, _HELP))
        from xrgs.bench.run import run

        say(run(cast("Settings", settings)))
