"""`xrgs-report`: makes the tables and figures of sweeps, from the store alone, and lists sweeps."""

from __future__ import annotations

from typing import Annotated

from tyro.conf import arg

from xrgs.cli import options
from xrgs.cli.options import STORE, Folder, Names, OptionalFolder, shown_as
from xrgs.runtime.streams import say
from xrgs.store.store import BASELINE, Store

_DESCRIPTION = """\
Make the tables and figures of a sweep from a store alone; the same store gives the same bytes.

report.html is a page with all of it, the photographs and the Gaussians: one file, without network.
The report of a sweep that runs or was stopped has the cells that are done."""


def report(
    store: Folder = STORE,
    sweep: Annotated[tuple[str, ...], shown_as("ID ...")] = (),
    scenes: Names = (),
    ablations: Names = (),
    out: OptionalFolder = None,
    pictures: Annotated[tuple[str, ...], arg(metavar="NAME ...")] = ("all",),
    against: Annotated[str, arg(metavar="LABEL")] = BASELINE,
    external: Annotated[tuple[str, ...], shown_as("[LABEL:]FOLDER ...")] = (),
    outcomes: Names = (),
    headline: Names = (),
    margin_psnr: float = 0.2,
    margin_lpips: float = 5.0,
) -> None:
    """Make the tables and figures of a sweep.

    Args:
        store: The store.
        sweep: The sweep: its id, the beginning of it, or the name of a scene for the latest sweep
            of it. Several are joined, for example one of each scene. By default the latest.
        scenes: The scenes in the report; all by default.
        ablations: The ablations in the report, beside what they are compared with; all by default.
        out: Folder to write to. By default reports/ID in the store; with a choice
            reports/ID.scenes-NAMES or reports/ID.ablations-NAMES, and with another label to compare
            with reports/ID.against-LABEL.
        pictures: `all`, `none`, or names of figures without their ending, such as `trade-off` or
            `fern--plus`. `none` leaves the pictures of report.html out too.
        against: The label that all others are compared with. In a sweep with `baseline=false` it is
            the first by default.
        external: Another program's renders of the test views, as one more label. FOLDER has
            SCENE/VIEW.png, or VIEW.png where there is one scene, as 8-bit RGB of the photograph's
            size.
        outcomes: The metrics that have a verdict, and whose tests are corrected together; all
            others are descriptive. Name them before the data. By default psnr, psnr_pooled,
            psnr_worst, lpips, evaluations and gaussians.
        headline: The labels of a study's claims: their tests are corrected by Holm.
        margin_psnr: A change of PSNR that is shown to be smaller is called equivalent, dB.
        margin_lpips: The same for LPIPS, %.
    """
    from xrgs.report import Choice, Design, build
    from xrgs.report.external import parse

    drawn = None if pictures == ("all",) else [name for name in pictures if name != "none"]
    choice = Choice(scenes, ablations)
    design = Design(outcomes or Design.outcomes, headline, margin_psnr, margin_lpips)
    others = parse(external)
    ids = [Store(store).find_sweep(word) for word in sweep]
    say(build(store, ids or None, out, drawn, against, choice, others, design).text)


def list_sweeps(store: Folder = STORE) -> None:
    """List the sweeps of a store, the latest last: id, date, labels, scenes, cells done.

    Args:
        store: The store.
    """
    from xrgs.sweep import inventory

    say(inventory.list_sweeps(Store(store).sweep_rows()))


def main() -> None:
    """Run `xrgs-report` or `xrgs-report list`."""
    options.run(
        "xrgs-report", {"report": report, "list": list_sweeps}, _DESCRIPTION, default="report"
    )
