"""What became of the photographs of each scene, as the reports of its variants say it."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from xrgs.capture.description import SfmReport
from xrgs.errors import StoreError

if TYPE_CHECKING:
    from xrgs.report.collect import Sweep
    from xrgs.report.joined import JoinedStore

#: The most names in a sentence on views that are not placed: all that a scene is likely to have.
_MAX_NAMES = 200


def with_variants(sweep: Sweep, store: JoinedStore) -> Sweep:
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

    A scene has several variants where HR views are drawn more than once.
    """
    done = sweep.cells[sweep.cells["variant_id"].isin(sweep.variants)]
    found = []
    for scene, ids in done.groupby("scene", sort=False)["variant_id"]:
        notes = [n for name in ids.unique() for n in sweep.variants[name].all_notes(_MAX_NAMES)]
        found.append((str(scene), tuple(dict.fromkeys(notes))))
    return [(scene, notes) for scene, notes in found if notes]
