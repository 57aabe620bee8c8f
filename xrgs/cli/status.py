"""`xrgs-status`: what a store holds, at a glance."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

from omegaconf.errors import OmegaConfBaseException

from xrgs import config
from xrgs.cli.arguments import parse
from xrgs.errors import XrgsError


@dataclass
class StatusConf:
    """Arguments of `xrgs-status`."""

    store: str = "xrgs-store"
    verify: bool = False
    """Hash what reports rest on too; sizes alone are compared without."""


def main() -> None:
    """`xrgs-status [store=FOLDER] [verify=true]`: what a store holds, at a glance."""
    from xrgs.sweep.status import describe, read

    try:
        conf = parse(StatusConf, main)
        print(describe(read(Path(conf.store), verify=conf.verify)))  # noqa: T201
    except (XrgsError, OmegaConfBaseException) as error:
        sys.exit(f"xrgs-status: {config.one_line(error)}")
