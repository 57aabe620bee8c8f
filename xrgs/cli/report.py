"""`xrgs-report`: makes the tables and figures of a sweep, from the store alone."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from xrgs.cli.arguments import errors_as_messages, parse
from xrgs.experiment.store import BASELINE
from xrgs.runtime.streams import say

_HELP = """\
xrgs-report [KEY=VALUE]...

Makes the tables and figures of a sweep, from the store alone; the same store gives the same bytes.
report.html is a page with all of it, the photographs and the Gaussians: one file, without network.

  store=FOLDER     the store; xrgs-store by default
  sweep=ID         id of the sweep; the latest by default
  out=FOLDER       folder to write to; STORE/reports/ID by default
  pictures=NAMES   all, none, or names of figures without their ending: trade-off,fern--plus;
                   none leaves the pictures of report.html out too
  against=LABEL    the label that all others are compared with; baseline by default. The report of
                   another one is in STORE/reports/ID.against-LABEL
"""


@dataclass
class ReportConf:
    """Arguments of `xrgs-report`."""

    store: str = "xrgs-store"
    """The store's folder."""
    sweep: str | None = None
    """Id of the sweep; None for the latest."""
    out: str | None = None
    """Folder to write to; None for `<store>/reports/<sweep>`."""
    pictures: str = "all"
    """`all`, `none`, or names of figures without their ending: `trade-off,fern--plus`."""
    against: str = BASELINE
    """The label that all others are compared with."""


def main() -> None:
    """Run `xrgs-report [KEY=VALUE]...`."""
    with errors_as_messages("xrgs-report"):
        conf = parse(ReportConf, _HELP)
        from xrgs.report import build

        out = Path(conf.out) if conf.out else None
        pictures = {"all": None, "none": []}.get(conf.pictures, conf.pictures.split(","))
        say(build(Path(conf.store), conf.sweep, out, pictures, conf.against).text)
