"""`xrgs-report`: the tables and pictures of a sweep, from the store alone."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

from omegaconf.errors import OmegaConfBaseException

from xrgs import config
from xrgs.cli.arguments import parse
from xrgs.errors import XrgsError


@dataclass
class ReportConf:
    """Arguments of `xrgs-report`."""

    store: str = "xrgs-store"
    sweep: str | None = None
    """Id of the sweep; the latest where none is given."""
    out: str | None = None
    """Folder to write to; `<store>/reports/<sweep>` where none is given."""
    pictures: str = "all"
    """`all`, `none`, or files' names without their suffix: `trade-off,fern--plus`."""


def main() -> None:
    """`xrgs-report [KEY=VALUE ...]`: tables and pictures of a sweep, from the store alone."""
    try:
        conf = parse(ReportConf, main)
        from xrgs.report import build

        out = Path(conf.out) if conf.out else None
        names = {"all": None, "none": []}.get(conf.pictures, conf.pictures.split(","))
        print(build(Path(conf.store), conf.sweep, out, names).text)  # noqa: T201
    except (XrgsError, OmegaConfBaseException) as error:
        sys.exit(f"xrgs-report: {config.one_line(error)}")
