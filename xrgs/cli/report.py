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

  store=FOLDER     the store; xrgs-store by default
  sweep=ID         id of the sweep; the latest by default
  out=FOLDER       folder to write to; STORE/reports/ID by default
  pictures=NAMES   all, none, or names of figures without their ending: trade-off,fern--plus
  against=LABEL    the label that all others are compared with; baseline by default. The report of
                   another one is in STORE/reports/ID.against-LABEL
  external=[LABEL:]FOLDER[,...]
                   renders of the test views by another program become one more label: FOLDER has
                   SCENE/VIEW.png, or VIEW.png where there is one scene, as 8-bit RGB of the
                   photograph's size
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
    external: str = ""
    """Folders of other programs' renders, each with its label: `gsplat:FOLDER,other:FOLDER`."""


def main() -> None:
    """Run `xrgs-report [KEY=VALUE]...`."""
    with errors_as_messages("xrgs-report"):
        conf = parse(ReportConf, _HELP)
        from xrgs.report import build, external

        out = Path(conf.out) if conf.out else None
        pictures = {"all": None, "none": []}.get(conf.pictures, conf.pictures.split(","))
        others = external.parse(conf.external)
        say(build(Path(conf.store), conf.sweep, out, pictures, conf.against, others).text)
