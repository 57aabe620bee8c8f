"""`xrgs-status`: prints a summary of a store."""

from __future__ import annotations

from functools import partial

from xrgs.cli import options
from xrgs.cli.options import STORE, Flag, Folder
from xrgs.runtime.streams import say


def status(store: Folder = STORE, watch: Flag = False) -> None:
    """Print what a store holds: cells by state, ids of done cells, why others failed, and sizes.

    It also says which cell is trained now, and for which sweep. `xrgs-store list` lists all cells,
    and `xrgs-store check` verifies them.

    Args:
        store: The store.
        watch: Show the cells in training, updated until Ctrl-C; the trainings go on after it.
    """
    from xrgs.sweep.status import describe
    from xrgs.sweep.status import watch as watch_store

    if watch:
        watch_store(store)
    else:
        say(describe(store))


main = partial(options.run, "xrgs-status", status)
