"""What training did: where to look when a component changes nothing, or harms.

Steps on views of each tag, what each rule of densification did, and what components noted.
"""

from __future__ import annotations

from statistics import fmean
from typing import TYPE_CHECKING

import pandas as pd

from xrgs.report.render import Grid
from xrgs.safeio.records import as_number, read_table

if TYPE_CHECKING:
    from collections.abc import Sequence

    from xrgs.experiment.store import CellFolder, Store

_LABELS = {
    "steps_HR": "Steps on HR views",
    "steps_LR": "Steps on LR views",
    "duplicated": "Gaussians duplicated",
    "split": "Gaussians split",
    "pruned_opacity": "Pruned: transparent",
    "pruned_scale": "Pruned: too large",
    "pruned_non_finite": "Pruned: not finite",
    "reset": "Opacities reset",
}
#: Of a logged step, and not of the training up to it.
_OF_ONE_STEP = frozenset({"step", "view", "loss", "gaussians"})


def totals(store: Store, cells: pd.DataFrame) -> pd.DataFrame:
    """What training did in every cell that is done.

    Args:
        store: that holds them.
        cells: `Comparison.cells`.

    Returns:
        One row a cell: `cell_id`, `scene`, `label`, `condition`, `seed`, and a column for each
        count of its history (over the whole of training) and each note of a component (its mean
        over training); NaN where a cell has none.
    """
    done = cells[cells["state"] == "done"].drop_duplicates("cell_id")
    keys = done[["cell_id", "scene", "label", "condition", "seed"]].reset_index(drop=True)
    return keys.join(pd.DataFrame([_totals(store.cell(name)) for name in keys["cell_id"]]))


def _totals(cell: CellFolder) -> dict[str, float]:
    header, rows = read_table(cell.path / "history.csv")
    if not rows:
        return {}
    found = {}
    for at, name in enumerate(header):
        if name in _OF_ONE_STEP:
            continue
        if _is_note(name):
            values = [as_number(row[at]) for row in rows if row[at]]
            if values:
                found[name] = fmean(values)
        else:
            found[name] = as_number(rows[-1][at])  # counted from the first step on
    return found


def _is_note(name: str) -> bool:
    """Components put their own name and a dot before what they note."""
    return "." in name


def table(totals: pd.DataFrame, labels: Sequence[str], condition: str) -> Grid:
    """The totals of one condition, scene by scene, means over seeds.

    Args:
        totals: of `totals`.
        labels: the columns, in order.
        condition: which.
    """
    found = totals[totals["condition"] == condition]
    names = [name for name in _ordered(totals) if found[name].notna().any()]
    means = found.groupby(["scene", "label"])[names].mean().to_dict("index")
    rows = []
    for scene in sorted(found["scene"].unique()):
        of_scene = [means.get((scene, label), {}) for label in labels]
        for name in names:
            texts = [_text(values.get(name), note=_is_note(name)) for values in of_scene]
            if any(texts):
                rows.append((scene, _LABELS.get(name, name.replace("_", " ")), *texts))
    title = "What training did, means over the seeds that are done"
    return Grid(
        title=f"{title} ({condition})" if condition else title,
        columns=("Scene", "", *labels),
        rows=tuple(rows),
        align="ll" + "r" * len(labels),
        notes=("names with a dot: a component's own notes, their mean over training",),
    )


def _ordered(totals: pd.DataFrame) -> list[str]:
    """The columns that are numbers: known ones, then the components', each in their order."""
    numbers = [*totals.columns[5:]]
    return sorted(numbers, key=lambda name: (name not in _LABELS, _is_note(name)))


def _text(value: float | None, *, note: bool) -> str:
    if value is None or pd.isna(value):
        return ""
    return f"{value:.4g}" if note else f"{value:,.0f}"
