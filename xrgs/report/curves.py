"""Quality during training, and the time until a cell reaches the final quality of its base.

A cell trained with `train.evaluate_every=N` has the mean scores of its test views every N steps.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence

import pandas as pd

from xrgs.report.collect import CELL_KEYS, CURVE_COLUMNS, DoneCell
from xrgs.report.markup import titled
from xrgs.runtime.text import TextTable

_NOT_REACHED = "not reached"


def joined(cells: pd.DataFrame, done: Mapping[str, DoneCell]) -> pd.DataFrame:
    """Join the curves of all of `Comparison.cells` that were evaluated during training.

    There is a row for each evaluation, with `CELL_KEYS` and `CURVE_COLUMNS`, by cell and step.
    """
    rows = [
        {"cell_id": cell_id, **row}
        for cell_id, cell in done.items()
        if len(cell.curve) > 1
        for row in cell.curve
    ]
    curves = pd.DataFrame(rows, columns=["cell_id", *CURVE_COLUMNS])
    return cells[CELL_KEYS].drop_duplicates().merge(curves, on="cell_id")


def means_over_runs(curves: pd.DataFrame, condition: str) -> pd.DataFrame:
    """Average the curves of one condition, as `joined` returns them, over the runs of a scene.

    The columns are `label`, `scene` and `CURVE_COLUMNS`, with a row for each step at which all runs
    of a scene and label were evaluated, in the order of the labels.
    """
    return _means(curves[curves["condition"] == condition], ["label", "scene"])


def means_over_scenes(scenes: pd.DataFrame) -> pd.DataFrame:
    """Average the curves of `means_over_runs` over the scenes that all labels have.

    The columns are `label` and `CURVE_COLUMNS`; there is no row if no scene has all labels.
    """
    labels = scenes.groupby("scene")["label"].nunique()
    common = labels.index[labels == scenes["label"].nunique()]
    return _means(scenes[scenes["scene"].isin(common)], ["label"])


def _means(rows: pd.DataFrame, by: list[str]) -> pd.DataFrame:
    """Return the means over rows with the same keys `by`, at the steps that all their runs have."""
    grouped = rows.groupby([*by, "step"], sort=False)
    means, counts = grouped[CURVE_COLUMNS[1:]].mean(), grouped.size()
    means = means.mask(grouped[CURVE_COLUMNS[1:]].count().lt(counts, axis=0))
    means = means[counts == counts.groupby(level=by).transform("max")]
    return means.reset_index()


def first_reaches(quality: Sequence[float], amounts: Sequence[float], target: float) -> float:
    """Return the amount of time or work at which a curve first reaches a quality, higher is better.

    It is interpolated linearly between the first evaluation that reaches the target and the one
    before it. If the first evaluation reaches it, it is its amount; NaN if none does. A quality of
    NaN was not measured.

    Examples:
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


def times(cells: pd.DataFrame, done: Mapping[str, DoneCell]) -> pd.DataFrame:
    """Return the time and work in which each of `Comparison.cells` reaches its base's final PSNR.

    There is a row for each cell that was evaluated during training and whose base is done, with
    `CELL_KEYS`, the `target` (dB), and `evaluations` and `seconds` until the mean PSNR of the test
    views first reaches it, NaN if it never does. Each of the two also has a ratio `_share`, to the
    base's whole training, and `_own_share`, to what the base takes until it first reaches its own
    final PSNR (it may pass that early and fall again). If the base ran on another machine, the
    ratios of time are NaN.
    """
    rows = []
    finished = cells[cells["cell_id"].isin(done)].drop_duplicates(CELL_KEYS)
    for cell in finished.to_dict("records"):
        curve, base = done[cell["cell_id"]].curve, done.get(cell["base_id"])
        if len(curve) == 1 or base is None or math.isnan(base.curve[-1]["psnr"]):
            continue
        end = base.curve[-1]
        row = {key: cell[key] for key in CELL_KEYS} | {"target": end["psnr"]}
        for name in ("evaluations", "seconds"):
            row[name], own = (
                first_reaches([at["psnr"] for at in run], [at[name] for at in run], end["psnr"])
                for run in (curve, base.curve)
            )
            comparable = not cell["elsewhere"] or name != "seconds"
            for share, whole in (("share", end[name]), ("own_share", own)):
                has_share = comparable and whole > 0
                row[f"{name}_{share}"] = row[name] / whole if has_share else math.nan
        rows.append(row)
    return pd.DataFrame(rows, columns=[*CELL_KEYS, "target", *_ROWS])


#: Column of `times` -> the row of a table: its name (`{base}` is the base's label), the factor of
#: its number, and the number's format.
_ROWS = {
    "evaluations": ("Alpha evaluations, 10^9", 1e-9, ",.3g"),
    "evaluations_share": ("Evaluations, % of {base}'s whole training", 100.0, ".0f"),
    "evaluations_own_share": ("Evaluations, % of {base}'s own first passage", 100.0, ".0f"),
    "seconds": ("Time, s", 1.0, ",.1f"),
    "seconds_share": ("Time, % of {base}'s whole training", 100.0, ".0f"),
    "seconds_own_share": ("Time, % of {base}'s own first passage", 100.0, ".0f"),
}


def table(reached: pd.DataFrame, labels: Sequence[str], condition: str, base: str) -> TextTable:
    """Return the table of `times` for one condition.

    It has rows for each scene, means over its runs, and with several scenes the mean shares.
    """
    chosen = reached[reached["condition"] == condition]
    rows = [
        row
        for scene in sorted(chosen["scene"].unique())
        for row in _rows_of(scene, chosen[chosen["scene"] == scene], labels, _ROWS, base)
    ]
    if len(set(chosen["scene"])) > 1:
        # Each scene counts once; if one of its runs does not reach the target, it is NaN.
        scenes = chosen.groupby(["label", "scene"], sort=False)[[*_ROWS]].agg(_mean_of_all)
        shares = [name for name in _ROWS if name.endswith("_share")]
        rows += _rows_of("mean over scenes", scenes.reset_index(), labels, shares, base)
    return TextTable(
        title=titled(f"Work and time to the PSNR at which {base} ends", condition),
        columns=("Scene", "", *labels),
        rows=tuple(rows),
        align="ll" + "r" * len(labels),
        notes=(
            f"until the mean PSNR of the test views first reaches the final PSNR of {base} on the"
            " same scene and replicate, linear between two evaluations; mean over the runs of a"
            " scene",
            "a run that reaches it before its first evaluation has the time of that evaluation",
            f"own first passage: where {base} itself first reaches that PSNR; it may fall again",
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
    """Return a mean as text, or why there is none; empty without rows."""
    if rows is None:
        return ""
    reached = int(rows[name.partition("_")[0]].notna().sum())
    if reached < len(rows):
        return (
            _NOT_REACHED if reached == 0 else f"{_NOT_REACHED} {len(rows) - reached} of {len(rows)}"
        )
    _, factor, how = _ROWS[name]
    mean = _mean_of_all(rows[name])
    return "n/a" if math.isnan(mean) else format(factor * mean, how)
