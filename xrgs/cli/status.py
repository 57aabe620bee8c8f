"""`xrgs-status`: prints a summary of a store."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from xrgs.cli.arguments import errors_as_messages, parse
from xrgs.runtime.streams import say

_HELP = """\
xrgs-status [KEY=VALUE]...

Prints what a store holds: cells by state, which cell is trained now and for which sweep, why cells
failed, which cells are stale, and sizes. xrgs-store lists single cells, and verifies them.

  store=FOLDER     the store; xrgs-store by default
"""


@dataclass
class StatusConf:
    """Arguments of `xrgs-status`."""

    store: str = "xrgs-store"
    """The store's folder."""


def main() -> None:
    """Run `xrgs-status [KEY=VALUE]...`."""
    with errors_as_messages("xrgs-status"):
        conf = parse(StatusConf, _HELP)
        from xrgs.sweep.status import describe, read

        say(describe(read(Path(conf.store))))
