"""`xrgs-view`: shows one or two trained cells live in a browser, under one camera."""

from __future__ import annotations

import threading
from contextlib import suppress
from dataclasses import dataclass

from xrgs.cli.arguments import errors_as_messages, parse_with_words
from xrgs.errors import XrgsError
from xrgs.experiment.store import Store
from xrgs.runtime.signals import StopSignal, exit_on_signal
from xrgs.runtime.streams import say
from xrgs.safeio.paths import user_path
from xrgs.safeio.sanitize import for_line

_HELP = """\
xrgs-view CELL [CELL] [KEY=VALUE]...

Shows trained cells in a browser on this machine: the splats, and the cameras of the views coloured
by tag; two cells side by side under one camera. Ctrl-C ends it. It needs viser: pip install
'xrgs[view]'. CELL is a cell's id, the beginning of one, or a .ply file.

  port=8080        port of the page on 127.0.0.1; the next ones are used too
  limit=500000     the most Gaussians of a cell that are drawn: the most opaque ones
  store=FOLDER     the store; xrgs-store by default
"""


@dataclass
class ViewConf:
    """Arguments of `xrgs-view`."""

    port: int = 8080
    """Port of the page on this machine; 0 for any that is free."""
    limit: int = 500_000
    """The most Gaussians of a cell that are drawn."""
    store: str = "xrgs-store"
    """The store's folder."""


def main() -> None:
    """Run `xrgs-view CELL [CELL] [KEY=VALUE]...`."""
    with errors_as_messages("xrgs-view"):
        words, conf = parse_with_words(ViewConf, _HELP)
        if conf.limit < 1:
            raise XrgsError(f"limit={conf.limit}: must be at least 1")
        from xrgs.viewer.live import count_text, shown
        from xrgs.viewer.models import load_models

        with exit_on_signal("Nothing was changed."):
            models = load_models(words, Store(user_path(conf.store)))
            with shown(models, conf.port, conf.limit) as address:
                for model in models:
                    say(for_line(f"{model.name}: {count_text(model, conf.limit)}"))
                say(f"Open {address} in a browser; Ctrl-C ends.")
                with suppress(StopSignal):
                    threading.Event().wait()
