"""`xrgs-bench`: measures the run time, error and memory of rendering and training."""

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

  repeats=9        how often each task is timed; tasks that are compared take turns
  threads=0        number of threads to measure besides 1; 0 for one for each core
  seed=0           seed of the random loads
  smoke=true       use tiny loads, to check that everything runs
  out=FOLDER       folder of the .csv files and of bench.png; xrgs-bench by default
  json=FILE        also write all results to a JSON file

  load=FILE.npz    measure the Gaussians and the view in this file instead of random ones
  save=FILE.npz cell=FOLDER view=NAME
                   write such a file from a view of a trained cell, and measure nothing
  against=PYTHON   time this installation and another in turn, the one in the environment of that
                   Python executable; into against.csv
"""


def main() -> None:
    """Run `xrgs-bench [KEY=VALUE]...`."""
    set_passive_openmp_wait()  # as in training
    with errors_as_messages("xrgs-bench"):
        settings = OmegaConf.to_object(parse(Settings, _HELP))
        from xrgs.bench.run import run

        say(run(cast("Settings", settings)))
