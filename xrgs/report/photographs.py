"""What became of the photographs of each scene, and what trainings found out about them."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from xrgs.errors import StoreError
from xrgs.store.inspect import SfmReport

if TYPE_CHECKING:
    from collections.abc import Iterator

    import pandas as pd

    from xrgs.report.collect import Sweep
    from xrgs.report.joined import ReportStore

#: The most names in a sentence on views that are not placed: all that a scene is likely to have.
_MAX_NAMES = 200


def with_variants(sweep: Sweep, store: ReportStore) -> Sweep:
    """Return a sweep with the reports of its finished cells' variants.

    A variant whose report can't be read has a report that says so.
    """
    done = sweep.cells[sweep.cells["cell_id"].isin(sweep.done)]
    found = {}
    for variant_id in done["variant_id"].unique():
        try:
            found[variant_id] = store.variant_report(variant_id)
        except StoreError as error:
            why = store.without_paths(str(error))
            found[variant_id] = SfmReport(notes=(f"not known, what became of them: {why}",))
    return replace(sweep, variants=found)


def photographs(sweep: Sweep) -> list[tuple[str, tuple[str, ...]]]:
    """Return the name of each scene with finished cells, and sentences on its photographs.

    A scene has several variants where HR views are drawn more than once. What a training found
    (blur, exposure) comes after the label of its cell.
    """
    done = sweep.cells[sweep.cells["variant_id"].isin(sweep.variants)]
    found = []
    for scene, rows in done.groupby("scene", sort=False):
        variants = [sweep.variants[name] for name in rows["variant_id"].unique()]
        notes = [note for variant in variants for note in variant.all_notes(_MAX_NAMES)]
        found.append((str(scene), tuple(dict.fromkeys([*notes, *_found(sweep, rows)]))))
    return [(scene, notes) for scene, notes in found if notes]


def placement(sweep: Sweep, scene: str) -> str:
    """Say how the photographs of a scene were placed, from the report of its first variant."""
    rows = sweep.cells[(sweep.cells["scene"] == scene)]
    reports = [sweep.variants[name] for name in rows["variant_id"] if name in sweep.variants]
    if not reports or not reports[0].images:
        return "not known, how the photographs were placed"
    report = reports[0]
    by = "structure from motion" if report.poses is None else "the cameras that were given"
    error = report.reprojection_error_px
    parts = [f"{report.registered} of {report.images} photographs are placed by {by}"]
    parts += [f"{report.points:,} points"] if report.points else []
    parts += [] if error is None else [f"mean reprojection error {error:.2f} px"]
    return ", ".join(parts)


def _found(sweep: Sweep, rows: pd.DataFrame) -> Iterator[str]:
    """Yield what the cells of a scene found, behind their labels and, if several, replicates."""
    replicates = len(rows[["variant_seed", "seed"]].drop_duplicates())
    for row in rows[rows["cell_id"].isin(sweep.done)].to_dict("records"):
        replicate = f"replicate {row['variant_seed']}/{row['seed']}" * (replicates > 1)
        name = ", ".join(filter(None, (row["label"], row["condition"], replicate)))
        yield from (f"{name}: {line}" for line in sweep.done[row["cell_id"]].summary.found)
