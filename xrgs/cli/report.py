"""`xrgs-report`: makes the tables and figures of sweeps, from the store alone, and lists sweeps."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

from xrgs.cli.arguments import errors_as_messages, names_in, parse, paths_in
from xrgs.experiment.store import BASELINE, Store
from xrgs.runtime.streams import say

_HELP = """\
xrgs-report [KEY=VALUE]...

Makes the tables and figures of a sweep, from the store alone; the same store gives the same bytes.
report.html is a page with all of it, the photographs and the Gaussians: one file, without network.
Of a sweep that runs or was stopped, they have the cells that are done.

  store=FOLDER     the store; xrgs-store by default. With store=A,B the cells are looked for in both
  sweep=ID         id of the sweep; the latest by default, of several stores that of each.
                   sweep=ID,ID joins sweeps, for example one of each scene
  scenes=NAMES     the scenes that the report has, separated by commas; all by default
  ablations=NAMES  the ablations that it has, beside what they are compared with; all by default
  out=FOLDER       folder to write to; by default reports/ID in the first store, and with a choice
                   reports/ID.scenes-NAMES or reports/ID.ablations-NAMES
  pictures=NAMES   all, none, or names of figures without their ending: trade-off,fern--plus;
                   none leaves the pictures of report.html out too
  against=LABEL    the label that all others are compared with; baseline by default. The report of
                   another one is in STORE/reports/ID.against-LABEL
  external=[LABEL:]FOLDER[,...]
                   renders of the test views by another program become one more label: FOLDER has
                   SCENE/VIEW.png, or VIEW.png where there is one scene, as 8-bit RGB of the
                   photograph's size

xrgs-report list [store=FOLDER]

Lists the sweeps of a store, the latest last: id, date, labels, scenes, and how many cells are done.
"""


@dataclass
class ReportConf:
    """Arguments of `xrgs-report`."""

    store: str = "xrgs-store"
    """The store's folder; several, separated by commas, are read as one."""
    sweep: str | None = None
    """Id of the sweep; several, separated by commas, are joined. None for the latest."""
    scenes: str = ""
    """Names of scenes, separated by commas; empty for all."""
    ablations: str = ""
    """Labels, separated by commas; empty for all."""
    out: str | None = None
    """Folder to write to; None for `<store>/reports/<sweep>`."""
    pictures: str = "all"
    """`all`, `none`, or names of figures without their ending: `trade-off,fern--plus`."""
    against: str = BASELINE
    """The label that all others are compared with."""
    external: str = ""
    """Folders of other programs' renders, each with its label: `gsplat:FOLDER,other:FOLDER`."""


@dataclass
class ListConf:
    """Arguments of `xrgs-report list`."""

    store: str = "xrgs-store"
    """The store's folder."""


def main() -> None:
    """Run `xrgs-report [KEY=VALUE]...` or `xrgs-report list [store=FOLDER]`."""
    with errors_as_messages("xrgs-report"):
        if "list" in sys.argv[1:]:
            from xrgs.sweep.inventory import list_sweeps

            listed = parse(ListConf, _HELP, [word for word in sys.argv[1:] if word != "list"])
            say(list_sweeps(Store(Path(listed.store)).sweep_rows()))
            return
        conf = parse(ReportConf, _HELP)
        from xrgs.report import Choice, build, external

        out = Path(conf.out) if conf.out else None
        pictures = {"all": None, "none": []}.get(conf.pictures, conf.pictures.split(","))
        choice = Choice(names_in(conf.scenes), names_in(conf.ablations))
        sweeps = names_in(conf.sweep or "") or None
        others = external.parse(conf.external)
        say(build(paths_in(conf.store), sweeps, out, pictures, conf.against, choice, others).text)
