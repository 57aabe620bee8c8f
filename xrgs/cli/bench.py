"""`xrgs-bench`: measures the run time, error and memory of rendering and training."""

from __future__ import annotations

from functools import partial

from xrgs.bench.settings import Settings
from xrgs.cli import options
from xrgs.runtime.streams import say


def bench(settings: Settings) -> None:
    """Measure the run time of rendering and training on random loads, and its numerical error.

    Args:
        settings: The loads and methods, and the files of the results.
    """
    from xrgs.bench.run import run

    say(run(settings))


main = partial(options.run, "xrgs-bench", bench)
