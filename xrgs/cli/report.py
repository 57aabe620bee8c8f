"""`xrgs-report`: makes the tables and figures of sweeps from a store, and lists its sweeps."""

from __future__ import annotations

from functools import partial
from typing import Annotated

from tyro.conf import arg

from xrgs.cli import options
from xrgs.cli.options import STORE, Folder, Names, OptionalFolder, shown_as
from xrgs.runtime.streams import say
from xrgs.store.store import BASELINE, Store

_DESCRIPTION = """\
Make the tables and figures of a sweep, only from its store; the same store gives the same bytes.

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
        sweep: The sweep: its id, the beginning of its id, or the name of a scene for the scene's
            latest sweep. Several are joined, for example one of each scene. By default the latest.
        scenes: The scenes in the report; all by default.
        ablations: The ablations in the report, beside their base; all by default.
        out: Folder to write to. By default reports/ID in the store; with --scenes or --ablations
            reports/ID.scenes-NAMES or reports/ID.ablations-NAMES, and with --against
            reports/ID.against-LABEL.
        pictures: `all`, `none`, or names of figures without their suffix, such as `trade-off` or
            `fern--plus`. `none` leaves the pictures of report.html out too.
        against: The label that all others are compared with (the base). In a sweep with
            `baseline=false` it is the first label by default.
        external: Another program's renders of the test views, as one more label. FOLDER has
            SCENE/VIEW.png, or VIEW.png if there is one scene: 8-bit RGB, of the photograph's size.
        outcomes: The metrics that have a verdict, and whose tests are corrected together; all
            others are descriptive. Name them before you have the data. By default psnr,
            psnr_pooled, psnr_worst, lpips, evaluations and gaussians.
        headline: The labels of a study's claims: their tests are corrected by Holm.
        margin_psnr: A change of PSNR that is shown to be below this is called equivalent, dB.
        margin_lpips: A change of LPIPS that is shown to be below this is called equivalent, %.
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
    from xrgs.sweep import status

    say(status.list_sweeps(Store(store).sweep_rows()))


main = partial(
    options.run,
    "xrgs-report",
    {"report": report, "list": list_sweeps},
    _DESCRIPTION,
    default="report",
)
