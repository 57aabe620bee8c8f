"""Quality during training, and the time to the final quality of the base of the comparison.

A cell that was trained with `train.evaluate_every` has the mean scores of its test views after
every so many steps in `quality.csv`. Here the row of the trained cell is put behind these, and the
curves of all cells are joined.
"""

from __future__ import annotations

import math
from statistics import fmean
from typing import TYPE_CHECKING

import pandas as pd

from xrgs.errors import StoreError
from xrgs.evaluation.metrics import VIEW_METRICS
from xrgs.report.render import TextTable, titled
from xrgs.report.training import CELL_KEYS
from xrgs.safeio.records import as_number, read_table

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from xrgs.experiment.cell_folder import CellFolder

_AMOUNTS = ["step", "seconds", "evaluations", "gaussians"]
#: Columns of `quality.csv`: steps done, time and alpha evaluations so far, Gaussians, mean scores.
COLUMNS = [*_AMOUNTS, *VIEW_METRICS]
_NOT_REACHED = "not reached"


def cell_curve(cell: CellFolder) -> list[dict[str, float]]:
    """Return the quality of one cell during training, and at its end.

    Args:
        cell: A cell that is done.

    Returns:
        A row of `COLUMNS` for each evaluation, NaN where a score is missing. The last one is of the
        trained cell; it is the only one where the cell was not evaluated during training.

    Raises:
        StoreError: A file can't be read, or lacks a column; the message names the file.
        ValueError: A value is not a number.
    """
    summary, views = cell.summary(), [scores for _, scores in cell.view_scores()]
    last: dict[str, float] = {
        "step": summary.steps,
        "seconds": summary.training_time_s,
        "evaluations": summary.evaluations,
        "gaussians": summary.gaussians,
    }
    for name in VIEW_METRICS:
        last[name] = fmean(view.get(name, math.nan) for view in views) if views else math.nan
    file = cell.path / "quality.csv"
    if not file.is_file():
        return [last]
    header, rows = read_table(file)
    if missing := [name for name in _AMOUNTS if name not in header]:
        raise StoreError(f"{file}: there is no column {', '.join(missing)}")
    table = [dict(zip(header, row, strict=True)) for row in rows]
    return [{name: as_number(row.get(name)) for name in COLUMNS} for row in table] + [last]


def joined(
    cells: pd.DataFrame, of_cells: Mapping[str, Sequence[Mapping[str, float]]]
) -> pd.DataFrame:
    """Join the curves of all cells that were evaluated during training.

    Args:
        cells: The table `Comparison.cells`.
        of_cells: What `cell_curve` returns for each cell that is done, by its id.

    Returns:
        One row for each evaluation: `cell_id`, `scene`, `label`, `condition`, `variant_seed`,
        `seed`, and `COLUMNS`, in the order of the cells and of the steps.
    """
    done = cells.loc[cells["state"] == "done", CELL_KEYS].drop_duplicates()
    rows = [
        {"cell_id": cell_id, **row}
        for cell_id, curve in of_cells.items()
        if len(curve) > 1
        for row in curve
    ]
    return done.merge(pd.DataFrame(rows, columns=["cell_id", *COLUMNS]), on="cell_id")


def means_over_runs(curves: pd.DataFrame, condition: str) -> pd.DataFrame:
    """Average the curves of one condition over the runs of a scene and label.

    Args:
        curves: The table that `joined` returns.
        condition: The condition that the cells were run under.

    Returns:
        `label`, `scene` and `COLUMNS`: one row for each step after which all runs were evaluated,
        in the order of the labels.
    """
    return _means(curves[curves["condition"] == condition], ["label", "scene"])


def means_over_scenes(scenes: pd.DataFrame) -> pd.DataFrame:
    """Average curves over the scenes that all labels have, each of which counts once.

    Args:
        scenes: The table that `means_over_runs` returns.

    Returns:
        `label` and `COLUMNS`; no row where no scene has all labels.
    """
    labels = scenes.groupby("scene")["label"].nunique()
    common = labels.index[labels == scenes["label"].nunique()]
    return _means(scenes[scenes["scene"].isin(common)], ["label"])


def _means(rows: pd.DataFrame, by: list[str]) -> pd.DataFrame:
    """Return the means of the rows that share the keys `by` and a step that all of them have."""
    grouped = rows.groupby([*by, "step"], sort=False)
    means, counts = grouped[COLUMNS[1:]].mean(), grouped.size()
    means = means.mask(grouped[COLUMNS[1:]].count().lt(counts, axis=0))
    means = means[counts == counts.groupby(level=by).transform("max")]
    return means.reset_index()


def first_reaches(quality: Sequence[float], amounts: Sequence[float], target: float) -> float:
    """Return the amount at which a curve first reaches a target.

    Args:
        quality: Quality at each evaluation, NaN where it was not measured; higher is better.
        amounts: Time or work so far at each evaluation.
        target: The quality to reach.

    Returns:
        The amount, linear between the first evaluation that has reached the target and the one
        before it; that of the first evaluation where it has; NaN where none has.

    Example:
        >>> first_reaches([20.0, 22.0, 21.0], [10.0, 20.0, 30.0], 21.5)
        17.5
    """
    before = None
    for value, amount in zip(quality, amounts, strict=True):
        if value >= target:
            if before is None or not value > before[0]:
                return amount
            share = (target - before[0]) / (value - before[0])
            return before[1] + share * (amount - before[1])
        if not math.isnan(value):
            before = value, amount
    return math.nan


def times(
    cells: pd.DataFrame, of_cells: Mapping[str, Sequence[Mapping[str, float]]]
) -> pd.DataFrame:
    """Return when each cell first reaches the PSNR at which its base ends.

    Args:
        cells: The table `Comparison.cells`.
        of_cells: What `cell_curve` returns for each cell that is done, by its id.

    Returns:
        One row for each cell that was evaluated during training and whose base is done:
        the keys of the cell, `target` (the base's final PSNR of this scene and replicate, dB),
        `seconds` and `evaluations` until the mean PSNR of the test views first is that, and their
        `seconds_share` and `evaluations_share` of the base's totals; NaN where it is not
        reached, and no share of a time that another machine took.
    """
    rows = []
    for _, cell in cells[cells["state"] == "done"].drop_duplicates(CELL_KEYS).iterrows():
        curve, of_base = of_cells[cell["cell_id"]], of_cells.get(cell["base_id"])
        if len(curve) == 1 or not of_base or math.isnan(of_base[-1]["psnr"]):
            continue
        end = of_base[-1]
        row = dict(cell[CELL_KEYS]) | {"target": end["psnr"]}
        for name in ("seconds", "evaluations"):
            quality, amounts = ([at[key] for at in curve] for key in ("psnr", name))
            row[name] = first_reaches(quality, amounts, end["psnr"])
            row[f"{name}_share"] = row[name] / end[name] if end[name] else math.nan
        if cell["elsewhere"]:
            row["seconds_share"] = math.nan
        rows.append(row)
    return pd.DataFrame(rows, columns=[*CELL_KEYS, "target", *_ROWS])


#: The rows of a table for each column of `times`: name, in which `{base}` is the label that all
#: others are compared with, and factor and format of the number.
_ROWS = {
    "seconds": ("Time, s", 1.0, ",.1f"),
    "seconds_share": ("Time, % of {base}'s", 100.0, ".0f"),
    "evaluations": ("Alpha evaluations, 10^9", 1e-9, ",.3g"),
    "evaluations_share": ("Alpha evaluations, % of {base}'s", 100.0, ".0f"),
}


def table(found: pd.DataFrame, labels: Sequence[str], condition: str, base: str) -> TextTable:
    """Return the times of one condition, scene by scene, as means over the runs of a scene.

    Args:
        found: The table that `times` returns.
        labels: The labels of the columns, in order.
        condition: The condition that the cells were run under.
        base: The label that all others are compared with.

    Returns:
        The table, with means over scenes of the shares where there are several.
    """
    chosen = found[found["condition"] == condition]
    rows = [
        row
        for scene in sorted(chosen["scene"].unique())
        for row in _rows_of(scene, chosen[chosen["scene"] == scene], labels, _ROWS, base)
    ]
    if len(set(chosen["scene"])) > 1:
        # Each scene counts once; it is NaN, not reached, where one of its runs is.
        scenes = chosen.groupby(["label", "scene"], sort=False)[[*_ROWS]].agg(_mean_of_all)
        shares = [name for name in _ROWS if name.endswith("_share")]
        rows += _rows_of("mean over scenes", scenes.reset_index(), labels, shares, base)
    return TextTable(
        title=titled(f"Time and work to the PSNR at which {base} ends", condition),
        columns=("Scene", "", *labels),
        rows=tuple(rows),
        align="ll" + "r" * len(labels),
        notes=(
            f"until the mean PSNR of the test views first is {base}'s final one of the same"
            " scene and replicate, linear between two evaluations; mean over the runs of a scene",
            "one that reaches it before the first evaluation has the time of that one",
        ),
    )


def _mean_of_all(values: pd.Series) -> float:
    return float(values.mean(skipna=False))


def _rows_of(
    head: str, chosen: pd.DataFrame, labels: Sequence[str], names: Iterable[str], base: str
) -> list[tuple[str, ...]]:
    by_label = dict(iter(chosen.groupby("label")))
    return [
        (
            head,
            _ROWS[name][0].format(base=base),
            *(_text(by_label.get(label), name) for label in labels),
        )
        for name in names
    ]


def _text(rows: pd.DataFrame | None, name: str) -> str:
    """Return a mean, or why there is none; empty where there is no row."""
    if rows is None:
        return ""
    reached = int(rows[name.removesuffix("_share")].notna().sum())
    if reached < len(rows):
        return (
            _NOT_REACHED if reached == 0 else f"{_NOT_REACHED} {len(rows) - reached} of {len(rows)}"
        )
    _, factor, how = _ROWS[name]
    mean = _mean_of_all(rows[name])
    return "n/a" if math.isnan(mean) else format(factor * mean, how)
