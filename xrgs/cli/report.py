"""`xrgs-report`: makes the tables and figures of sweeps, from the store alone, and lists sweeps."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import arg

from xrgs.cli import options
from xrgs.cli.options import STORE, Folder, Names, OptionalFolder, shown_as
from xrgs.errors import StoreError
from xrgs.runtime.streams import say
from xrgs.store.store import BASELINE, Store

if TYPE_CHECKING:
    from collections.abc import Sequence

_DESCRIPTION = """\
Make the tables and figures of a sweep from a store alone; the same store gives the same bytes.

report.html is a page with all of it, the photographs and the Gaussians: one file, without network.
The report of a sweep that runs or was stopped has the cells that are done."""


def report(
    store: Annotated[tuple[Path, ...], arg(metavar="FOLDER ...")] = (STORE,),
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
        store: The store. With several, a cell is looked for in each.
        sweep: The sweep: its id, the beginning of it, or the name of a scene for the latest sweep
            of it. Several are joined, for example one of each scene. By default the latest, and
            with several stores the latest of each.
        scenes: The scenes in the report; all by default.
        ablations: The ablations in the report, beside what they are compared with; all by default.
        out: Folder to write to. By default reports/ID in the first store; with a choice
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
    ids = [find_sweep([Store(path) for path in store], word) for word in sweep]
    say(build(list(store), ids or None, out, drawn, against, choice, others, design).text)


def find_sweep(stores: Sequence[Store], word: str) -> str:
    """Return the id of the sweep that a word names in the first of the stores that has one.

    Raises:
        StoreError: None has; the message is the first store's.
    """
    errors = []
    for store in stores:
        try:
            return store.find_sweep(word)
        except StoreError as error:
            errors.append(error)
    raise errors[0]


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
