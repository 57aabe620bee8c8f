"""`xrgs-status`: prints a summary of a store."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

from xrgs.cli.arguments import errors_as_messages, parse
from xrgs.runtime.streams import say

_HELP = """\
xrgs-status [KEY=VALUE]...

Prints what a store holds: cells by state, why cells failed, which cells are stale, and sizes.

  store=FOLDER     the store; xrgs-store by default
  verify=true      hash every file of the finished cells, the variants, the rendered scenes and the
                   records of sweeps, and end with code 1 if a file is damaged or can't be read;
                   by default only the sizes of the cells' files are compared
"""


@dataclass
class StatusConf:
    """Arguments of `xrgs-status`."""

    store: str = "xrgs-store"
    """The store's folder."""
    verify: bool = False
    """Hash every file; otherwise only the sizes of the cells' files are compared."""


def main() -> None:
    """Run `xrgs-status [KEY=VALUE]...`."""
    with errors_as_messages("xrgs-status"):
        conf = parse(StatusConf, _HELP)
        from xrgs.sweep.status import describe, read

        status = read(Path(conf.store), verify=conf.verify)
        say(describe(status))
    if conf.verify and not status.intact:
        sys.exit(1)
