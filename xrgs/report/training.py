"""Tables of what training did, to see why a component changes nothing or makes results worse.

They count steps on views of each tag and what each rule of densification did, and have the means of
what components logged.
"""

from __future__ import annotations

from statistics import fmean
from typing import TYPE_CHECKING

import pandas as pd

from xrgs.report.render import TextTable, titled
from xrgs.safeio.records import as_number, read_table

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from xrgs.experiment.cell_folder import CellFolder

#: The columns that name a cell in the tables of what cells did.
CELL_KEYS = ["cell_id", "scene", "label", "condition", "variant_seed", "seed"]
_LABELS = {
    "steps_HR": "Steps on HR views",
    "steps_LR": "Steps on LR views",
    "duplicated": "Gaussians duplicated",
    "split": "Gaussians split",
    "pruned_opacity": "Pruned: transparent",
    "pruned_scale": "Pruned: too large",
    "pruned_non_finite": "Pruned: not finite",
    "pruned_by_components": "Pruned: by components",
    "reset": "Opacities reset",
    "skipped_backward": "Steps without a backward pass",
    "skipped_shN": "Steps that did not move shN",
}
#: Columns of a history that describe the logged step alone, not the training up to it.
_SINGLE_STEP_COLUMNS = frozenset({"step", "view", "loss", "gaussians"})


def totals(cells: pd.DataFrame, of_cells: Mapping[str, Mapping[str, float]]) -> pd.DataFrame:
    """Return what training did in each cell that is done.

    Args:
        cells: The table `Comparison.cells`.
        of_cells: What `cell_totals` returns for each cell that is done, by its id.

    Returns:
        One row for each cell: `cell_id`, `scene`, `label`, `condition`, `variant_seed`, `seed`,
        and a column for each count of its history (over the whole training) and each value that a
        component logged (its mean over training); NaN where a cell has none.
    """
    done = cells[cells["state"] == "done"].drop_duplicates("cell_id")
    keys = done[CELL_KEYS].reset_index(drop=True)
    return keys.join(pd.DataFrame([of_cells[name] for name in keys["cell_id"]]))


def cell_totals(cell: CellFolder) -> dict[str, float]:
    """Return what training did in one cell.

    Args:
        cell: The cell.

    Returns:
        The counts of its history, and the means of what components logged.

    Raises:
        StoreError: Its history can't be read; the message names the file.
        ValueError: A value of its history is not a number.
    """
    header, rows = read_table(cell.path / "history.csv")
    if not rows:
        return {}
    result = {}
    for column, name in enumerate(header):
        if name in _SINGLE_STEP_COLUMNS:
            continue
        if _is_component_log(name):
            values = [as_number(row[column]) for row in rows if row[column]]
            if values:
                result[name] = fmean(values)
        else:
            result[name] = as_number(rows[-1][column])  # counts start at the first step
    return result


def _is_component_log(name: str) -> bool:
    """Return whether a component logged this column: a dot ends the component's name in it."""
    return "." in name


def table(totals: pd.DataFrame, labels: Sequence[str], condition: str) -> TextTable:
    """Return the totals of one condition, scene by scene, as means over seeds.

    Args:
        totals: The table that `totals` returns.
        labels: The labels of the columns, in order.
        condition: The condition that the cells were run under.
    """
    chosen = totals[totals["condition"] == condition]
    names = [name for name in _ordered(totals) if chosen[name].notna().any()]
    means = chosen.groupby(["scene", "label"])[names].mean().to_dict("index")
    rows = []
    for scene in sorted(chosen["scene"].unique()):
        of_scene = [means.get((scene, label), {}) for label in labels]
        for name in names:
            texts = [
                _text(values.get(name), is_component_log=_is_component_log(name))
                for values in of_scene
            ]
            if any(texts):
                rows.append((scene, _LABELS.get(name, name.replace("_", " ")), *texts))
    return TextTable(
        title=titled("What training did, means over the replicates that are done", condition),
        columns=("Scene", "", *labels),
        rows=tuple(rows),
        align="ll" + "r" * len(labels),
        notes=("names with a dot: values that a component logged, means over training",),
    )


def _ordered(totals: pd.DataFrame) -> list[str]:
    """Return the columns of numbers: known ones, then the components', each in their own order."""
    numbers = [name for name in totals.columns if name not in CELL_KEYS]
    return sorted(numbers, key=lambda name: (name not in _LABELS, _is_component_log(name)))


def _text(value: float | None, *, is_component_log: bool) -> str:
    if value is None or pd.isna(value):
        return ""
    return f"{value:.4g}" if is_component_log else f"{value:,.0f}"
