"""Percentage change of each metric from the paired baseline: the arithmetic of the paper's Table 1.

A pair is an ablation's cell and the baseline trained on the same variant with the same seed. The
change of a pair is 100 (value - baseline) / |baseline|; a scene's change is the mean over its
seeds, and the sweep's is the mean over scenes, each scene counting once.

The 95 % interval is Student's t around that mean. Its unit is a scene's mean where there is more
than one scene (it then says how far the mean would move with other scenes like these; the noise
between seeds is inside it), else a seed. One scene with one seed has no interval.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd
from scipy.special import stdtrit

from xrgs.experiment.store import BASELINE
from xrgs.report.collect import ReportError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from xrgs.evaluation.metrics import Metric

    Floats = NDArray[np.float64]

CONFIDENCE = 0.95
NOT_MEASURED = "not measured"
ZERO_BASELINE = "the baseline is zero"
NOT_FINITE = "not finite"

_GROUP = ["label", "condition"]


def percent_change(baseline: Floats, value: Floats) -> tuple[Floats, NDArray[np.str_]]:
    """Change from `baseline` to `value` in percent of the baseline's magnitude.

    The magnitude, so that a larger value is a positive change below zero too (SSIM and PSNR can
    be negative).

    Args:
        baseline: [N]
        value: [N]

    Returns:
        change [N], NaN where there is none, and why there is none [N], else empty.

    Example:
        >>> percent_change(np.array([20.0, 0.0]), np.array([25.0, 1.0]))[0]
        array([25., nan])
    """
    with np.errstate(all="ignore"):
        change = 100 * (value - baseline) / np.abs(baseline)
    change = np.where((baseline == 0) & (value == 0), 0.0, change)
    why = np.select(
        [
            np.isnan(baseline) | np.isnan(value),
            np.isfinite(value) & (baseline == 0) & (value != 0),
            ~np.isfinite(change),
        ],
        [NOT_MEASURED, ZERO_BASELINE, NOT_FINITE],
        default="",
    )
    return np.where(why == "", change, np.nan), why


def half_width(spread: Floats, n: Floats) -> Floats:
    """Half the width of Student's 95 % interval of a mean; NaN for fewer than two values.

    Args:
        spread: [N] sample standard deviations (n - 1).
        n: [N] how many values each is of.
    """
    with np.errstate(all="ignore"):
        return np.asarray(stdtrit(n - 1, 0.5 + CONFIDENCE / 2) * spread / np.sqrt(n))


@dataclass(frozen=True)
class Comparison:
    """Every number of a report's tables."""

    metrics: tuple[Metric, ...]
    scenes: tuple[str, ...]
    """Sorted."""
    groups: tuple[tuple[str, str], ...]
    """(label, condition) of each ablation, as the sweep ordered them."""
    cells: pd.DataFrame
    pairs: pd.DataFrame
    """One row an ablation's cell and metric: baseline, value, change (%), difference, why."""
    per_scene: pd.DataFrame
    """Means over seeds, indexed by label, condition, scene, metric."""
    means: pd.DataFrame
    """Means over scenes, indexed by label, condition, metric."""

    def missing(self) -> pd.DataFrame:
        """The cells that gave no number, with `reason`, in the sweep's order."""
        return self.cells[self.cells["reason"] != ""]


def compare(cells: pd.DataFrame, metrics: Sequence[Metric]) -> Comparison:
    """Pair every ablation with its baseline and average over seeds, then over scenes.

    Args:
        cells: `Sweep.cells`.
        metrics: the rows of the tables, in order.

    Raises:
        ReportError: a cell's baseline is of another scene, variant or seed, or not in the sweep;
            cells of one scene and condition are of different variants; or the cells were scored
            by different evaluation protocols. The message names both cells.
    """
    check_comparable(cells)
    cells = cells.copy()
    pairs = _pairs(cells, metrics)
    per_scene = _summary(pairs, [*_GROUP, "scene", "metric"], unit="seeds")
    ablations = cells[cells["label"] != BASELINE]
    return Comparison(
        metrics=tuple(metrics),
        scenes=tuple(sorted(cells["scene"].unique())),
        groups=tuple(dict.fromkeys(zip(ablations["label"], ablations["condition"], strict=True))),
        cells=cells,
        pairs=pairs,
        per_scene=per_scene,
        means=_over_scenes(per_scene),
    )


def check_comparable(cells: pd.DataFrame) -> None:
    """Refuse cells that no percentage may be made of; see `compare`."""
    _one_value(cells[cells["state"] == "done"], [], "protocol", "evaluation protocol")
    _one_value(cells.dropna(subset="variant_id"), ["scene", "condition"], "variant_id", "variant")
    ablations = cells[(cells["label"] != BASELINE) & cells["cell_id"].notna()]
    baselines = _baselines(cells)
    unknown = ablations[~ablations["baseline_id"].isin(baselines.index)]
    if not unknown.empty:
        row = unknown.iloc[0]
        raise ReportError(
            f"cell {row['cell_id']} ({_name(row)}): its baseline {row['baseline_id']} "
            "is not in the sweep"
        )
    matched = baselines.loc[ablations["baseline_id"]]
    for key in ("scene", "variant_id", "seed"):
        differs = ablations[key].to_numpy() != matched[key].to_numpy()
        if differs.any():
            at = int(np.argmax(differs))
            cell, base = ablations.iloc[at], matched.iloc[at]
            raise ReportError(
                f"cell {cell['cell_id']} ({_name(cell)}) has {key} {cell[key]}, "
                f"its baseline {cell['baseline_id']} has {key} {base[key]}: not a pair"
            )


def _one_value(cells: pd.DataFrame, within: list[str], key: str, label: str) -> None:
    """Refuse two values of `key` among the cells that share the keys `within`."""
    distinct = cells.drop_duplicates([*within, key])
    repeated = distinct[distinct.duplicated(within)] if within else distinct.iloc[1:]
    if repeated.empty:
        return
    second = repeated.iloc[0]
    same = (distinct[within] == second[within]).all(axis=1)
    first = distinct[same].iloc[0]
    raise ReportError(
        f"cells of different {label}s can't share a table: "
        f"{first['cell_id']} ({_name(first)}) has {first[key]}, "
        f"{second['cell_id']} ({_name(second)}) has {second[key]}"
    )


def _name(cell: pd.Series) -> str:
    parts = (cell["scene"], cell["label"], cell["condition"], f"seed {cell['seed']}")
    return ", ".join(str(part) for part in parts if part)


def _baselines(cells: pd.DataFrame) -> pd.DataFrame:
    """The baselines that were planned, one row a cell, indexed by its id."""
    planned = cells[(cells["label"] == BASELINE) & cells["cell_id"].notna()]
    return planned.drop_duplicates("cell_id").set_index("cell_id")


def _pairs(cells: pd.DataFrame, metrics: Sequence[Metric]) -> pd.DataFrame:
    """The pairs of which both are done; an ablation whose baseline is not gets that as reason."""
    baselines = _baselines(cells)
    ablations = cells["label"] != BASELINE
    lost = baselines[baselines["state"] != "done"]
    orphans = ablations & (cells["state"] == "done") & cells["baseline_id"].isin(lost.index)
    reasons = "no baseline: " + lost["reason"].astype(str)
    cells.loc[orphans, "reason"] = cells.loc[orphans, "baseline_id"].map(reasons).astype(str)
    paired = cells[ablations & (cells["state"] == "done") & ~orphans]
    matched = baselines.loc[paired["baseline_id"]]
    parts = []
    for metric in metrics:
        baseline = matched[metric.name].to_numpy(np.float64)
        value = paired[metric.name].to_numpy(np.float64)
        change, why = percent_change(baseline, value)
        with np.errstate(invalid="ignore"):  # inf - inf is the NaN that is meant
            difference = value - baseline
        part = paired[["label", "condition", "scene", "seed", "cell_id", "baseline_id"]]
        parts.append(
            part.assign(
                metric=metric.name,
                baseline=baseline,
                value=value,
                change=change,
                difference=difference,
                why=why,
            )
        )
    return pd.concat(parts, ignore_index=True)


def _summary(rows: pd.DataFrame, by: list[str], unit: str) -> pd.DataFrame:
    """Mean and interval of the rows that share the keys `by`; `why` names what was left out."""
    grouped = rows.groupby(by, sort=False)
    table = grouped.agg(
        baseline=("baseline", "mean"),
        value=("value", "mean"),
        change=("change", "mean"),
        difference=("difference", "mean"),
        spread=("change", "std"),
        n=("change", "count"),
    )
    half = half_width(table["spread"].to_numpy(), table["n"].to_numpy(np.float64))
    odd = rows[rows["why"] != ""].drop_duplicates([*by, "why"])
    why = odd.groupby(by, sort=False)["why"].agg("; ".join)
    return table.assign(
        low=table["change"] - half,
        high=table["change"] + half,
        unit=unit,
        why=why.reindex(table.index).fillna(""),
    )


def _over_scenes(per_scene: pd.DataFrame) -> pd.DataFrame:
    """Means over scenes; a group with one scene keeps that scene's interval, over its seeds."""
    by = [*_GROUP, "metric"]
    rows = per_scene.reset_index()
    means = _summary(rows, by, unit="scenes")
    only = rows[rows["change"].notna()].drop_duplicates(by, keep=False).set_index(by)
    columns = ["spread", "n", "low", "high", "unit"]
    means.loc[only.index, columns] = only[columns]
    return means
