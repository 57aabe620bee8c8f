"""Notes on each scene's photographs: how they were placed, what was left out or measured."""

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

#: The most names in a sentence on views that are not placed.
_MAX_NAMES = 200


def with_variants(sweep: Sweep, store: ReportStore) -> Sweep:
    """Return a sweep with the SfM reports of its finished cells' variants.

    If a report can't be read, its note says so.
    """
    done = sweep.cells[sweep.cells["cell_id"].isin(sweep.done)]
    reports = {}
    for variant_id in done["variant_id"].unique():
        try:
            reports[variant_id] = store.variant_report(variant_id)
        except StoreError as error:
            why = store.without_paths(str(error))
            reports[variant_id] = SfmReport(notes=(f"unknown what was done with them: {why}",))
    return replace(sweep, variants=reports)


def photographs(sweep: Sweep) -> list[tuple[str, tuple[str, ...]]]:
    """Return (scene, sentences on its photographs) for the scenes with finished cells.

    The sentences come from all variants of the scene, and from its cells' trainings (blur,
    exposure) with the cell's label.
    """
    done = sweep.cells[sweep.cells["variant_id"].isin(sweep.variants)]
    by_scene = []
    for scene, rows in done.groupby("scene", sort=False):
        variants = [sweep.variants[name] for name in rows["variant_id"].unique()]
        notes = [note for variant in variants for note in variant.all_notes(_MAX_NAMES)]
        by_scene.append((str(scene), tuple(dict.fromkeys([*notes, *_findings(sweep, rows)]))))
    return [(scene, notes) for scene, notes in by_scene if notes]


def placement(sweep: Sweep, scene: str) -> str:
    """Say how the photographs of a scene were placed, from the report of its first variant."""
    rows = sweep.cells[(sweep.cells["scene"] == scene)]
    reports = [sweep.variants[name] for name in rows["variant_id"] if name in sweep.variants]
    if not reports or not reports[0].images:
        return "it is unknown how the photographs were placed"
    report = reports[0]
    by = "structure from motion" if report.poses is None else "the cameras that were given"
    error = report.reprojection_error_px
    parts = [f"{report.registered} of {report.images} photographs are placed by {by}"]
    parts += [f"{report.points:,} points"] if report.points else []
    parts += [] if error is None else [f"mean reprojection error {error:.2f} px"]
    return ", ".join(parts)


def _findings(sweep: Sweep, rows: pd.DataFrame) -> Iterator[str]:
    """Yield the findings of a scene's trainings, each with its label and replicate."""
    replicates = len(rows[["variant_seed", "seed"]].drop_duplicates())
    for row in rows[rows["cell_id"].isin(sweep.done)].to_dict("records"):
        replicate = f"replicate {row['variant_seed']}/{row['seed']}" * (replicates > 1)
        name = ", ".join(filter(None, (row["label"], row["condition"], replicate)))
        yield from (f"{name}: {line}" for line in sweep.done[row["cell_id"]].summary.found)
