"""`xrgs-view`: shows one or two trained cells live in a browser, under one camera."""

from __future__ import annotations

import threading
from contextlib import suppress
from functools import partial

from tyro.conf import Positional

from xrgs.cli import options
from xrgs.cli.options import STORE, Cells, Folder
from xrgs.errors import XrgsError
from xrgs.runtime.signals import StopSignal
from xrgs.runtime.streams import say
from xrgs.safeio.sanitize import for_line
from xrgs.store.store import Store


def view(
    cells: Positional[Cells], port: int = 8080, limit: int = 500_000, store: Folder = STORE
) -> None:
    """Show trained cells in a browser on this machine; two of them side by side under one camera.

    The page has the splats, and the cameras of the views coloured by tag. Ctrl-C ends it. It needs
    viser: pip install 'xrgs[view]'.

    Args:
        cells: One cell or two, each by its id, the beginning of its id, the name of a scene with
            one done cell, or a file: .ply, .glb or .spz.
        port: Port of the page on 127.0.0.1; the next ones are used too. 0 takes any free ports.
        limit: The most Gaussians of a cell that are drawn: the most opaque ones.
        store: The store that has the cells.
    """
    if limit < 1:
        raise XrgsError(f"--limit {limit}: must be at least 1")
    from xrgs.viewer.live import NOT_ANTIALIASED, count_text, shown
    from xrgs.viewer.models import load_models

    models = load_models(cells, Store(store))
    with shown(models, port, limit) as address:
        for model in models:
            say(for_line(f"{model.name}: {count_text(model, limit)}"))
            if model.settings.antialiased:
                say(for_line(f"{model.name}: {NOT_ANTIALIASED}"))
        say(f"Open {address} in a browser; Ctrl-C ends.")
        with suppress(StopSignal):
            threading.Event().wait()


main = partial(options.run, "xrgs-view", view)
