"""Percentage change of each metric from the paired baseline, as in the paper's Table 1.

A pair is an ablation's cell and the baseline of the same scene and replicate. A replicate is a pair
of `variant.seed`, which draws the HR views, and `seed`, that of training: both cells are trained on
the same variant with the same seed. The change of a pair is 100 (value - baseline) / |baseline|. A
scene's change is the mean over its replicates, and the sweep's change is the mean over scenes, in
which each scene counts once.

The 95 % interval is Student's t around that mean. With more than one scene it is taken over the
scenes' means: it then says how far the mean would move with other scenes like these, and includes
the noise between replicates. With one scene it is taken over replicates. One scene with one
replicate has none. Beside it stands how many of the pairs changed in the direction of the mean.

Where a condition has `all_hr`, which trains on the originals of the degraded photographs, the share
of the gap that a pair closes is 100 (value - baseline) / (all_hr - baseline), of the three cells of
one scene and replicate, averaged in the same way: 0 is the baseline, 100 is what no method can
know. It needs all_hr to be better than the baseline. The scores of views have one; a gap in seconds
or Gaussians would mean nothing.
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

#: Label of the cells that the share of the gap is measured by.
ALL_HR = "all_hr"
NO_ALL_HR = "all_hr gave no number"
NO_GAP = "all_hr equals the baseline"
WRONG_GAP = "all_hr is worse than the baseline"

_GROUP = ["label", "condition"]


def percent_change(baseline: Floats, value: Floats) -> tuple[Floats, NDArray[np.str_]]:
    """Return the change from `baseline` to `value` in percent of the baseline's magnitude.

    The magnitude is taken so that a larger value is a positive change below zero as well: SSIM and
    PSNR can be negative.

    Args:
        baseline: [N] values of the baseline.
        value: [N] values of the ablation, in the same unit.

    Returns:
        The changes [N], NaN where there is none, and the reasons why there is none [N], empty where
        there is one.

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


def share_of_gap(
    baseline: Floats, value: Floats, all_hr: Floats, *, higher_is_better: bool
) -> tuple[Floats, NDArray[np.str_]]:
    """Return how much of the gap between the baseline and all_hr is closed, in percent.

    Args:
        baseline: [N] values of the baseline.
        value: [N] values of the ablation, in the same unit.
        all_hr: [N] values of all_hr, in the same unit; NaN where it gave none.
        higher_is_better: The direction of the metric.

    Returns:
        The shares [N], NaN where there is none, and the reasons why there is none [N], empty where
        there is one. A share is negative where the ablation is worse than the baseline, and above
        100 where it is better than all_hr.

    Example:
        >>> args = np.array([20.0]), np.array([23.0]), np.array([24.0])
        >>> share_of_gap(*args, higher_is_better=True)[0]
        array([75.])
    """
    with np.errstate(all="ignore"):
        gap = all_hr - baseline
        share = 100 * (value - baseline) / gap
    why = np.select(
        [
            np.isnan(baseline) | np.isnan(value),
            np.isnan(all_hr),
            gap == 0,
            gap < 0 if higher_is_better else gap > 0,
            ~np.isfinite(gap) | ~np.isfinite(share),
        ],
        [NOT_MEASURED, NO_ALL_HR, NO_GAP, WRONG_GAP, NOT_FINITE],
        default="",
    )
    return np.where(why == "", share, np.nan), why


def half_width(spread: Floats, n: Floats) -> Floats:
    """Return half the width of Student's 95 % interval of each mean.

    Args:
        spread: [N] sample standard deviations, with n - 1 in the denominator.
        n: [N] number of values behind each mean.

    Returns:
        [N] in the unit of `spread`; NaN for fewer than two values.
    """
    with np.errstate(all="ignore"):
        return np.asarray(stdtrit(n - 1, 0.5 + CONFIDENCE / 2) * spread / np.sqrt(n))


@dataclass(frozen=True)
class Comparison:
    """Holds every number of a report's tables."""

    metrics: tuple[Metric, ...]
    scenes: tuple[str, ...]
    """Names of the scenes, sorted."""
    groups: tuple[tuple[str, str], ...]
    """(label, condition) of each ablation, in the sweep's order."""
    cells: pd.DataFrame
    """`Sweep.cells`, in which an ablation without a finished baseline has that as its reason."""
    pairs: pd.DataFrame
    """One row for each metric of each ablation's cell: `baseline`, `value`, `change` (%),
    `difference` (in the metric's unit) and `why` there is no change."""
    per_scene: pd.DataFrame
    """Means over replicates, indexed by label, condition, scene, metric."""
    means: pd.DataFrame
    """Means over scenes, indexed by label, condition, metric."""
    gaps_per_scene: pd.DataFrame
    """As `per_scene`, with the share of the gap to all_hr (%) as the `change`: a row for each score
    of views and ablation in the conditions that have all_hr."""
    gaps: pd.DataFrame
    """As `means`, with that share as the `change`."""

    def missing(self) -> pd.DataFrame:
        """Return the cells without results, with `reason`, in the sweep's order."""
        return self.cells[self.cells["reason"] != ""]


def compare(cells: pd.DataFrame, metrics: Sequence[Metric]) -> Comparison:
    """Pair every ablation with its baseline and average over replicates, then over scenes.

    Args:
        cells: The table `Sweep.cells`.
        metrics: The metrics to compare, in the order of the tables' rows.

    Returns:
        The pairs, and their means over replicates and over scenes.

    Raises:
        ReportError: A cell's baseline is of another scene, variant or seed, or is not in the sweep;
            cells of one scene, condition and `variant.seed` are of different variants; the cells
            were scored by different evaluation protocols; or some of a condition were scored on
            held-out training views and others not. The message names both cells.
    """
    check_comparable(cells)
    cells = cells.copy()
    pairs = _pairs(cells, metrics)
    per_scene, means = _averaged(pairs)
    gaps_per_scene, gaps = _averaged(_gaps(pairs, cells, metrics))
    ablations = cells[cells["label"] != BASELINE]
    return Comparison(
        metrics=tuple(metrics),
        scenes=tuple(sorted(cells["scene"].unique())),
        groups=tuple(dict.fromkeys(zip(ablations["label"], ablations["condition"], strict=True))),
        cells=cells,
        pairs=pairs,
        per_scene=per_scene,
        means=means,
        gaps_per_scene=gaps_per_scene,
        gaps=gaps,
    )


def check_comparable(cells: pd.DataFrame) -> None:
    """Refuse cells that can't be compared.

    Args:
        cells: The table `Sweep.cells`.

    Raises:
        ReportError: As of `compare`.
    """
    done = cells[cells["state"] == "done"]
    _one_value(done, [], "protocol", "evaluation protocol")
    _one_value(done, ["condition"], "validation", "train.validation value")
    draw = ["scene", "condition", "variant_seed"]
    _one_value(cells.dropna(subset="variant_id"), draw, "variant_id", "variant")
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
    _check_pairs(ablations, matched, ("scene", "variant_id", "seed"))
    scored = ablations["validation"].notna().to_numpy() & matched["validation"].notna().to_numpy()
    _check_pairs(ablations[scored], matched[scored], ("validation",))


def _check_pairs(ablations: pd.DataFrame, matched: pd.DataFrame, keys: Sequence[str]) -> None:
    """Refuse an ablation that differs in a key from the baseline in the same row of `matched`."""
    for key in keys:
        differs = ablations[key].to_numpy() != matched[key].to_numpy()
        if differs.any():
            at = int(np.argmax(differs))
            cell, base = ablations.iloc[at], matched.iloc[at]
            raise ReportError(
                f"cell {cell['cell_id']} ({_name(cell)}) has {key} {cell[key]}, "
                f"its baseline {cell['baseline_id']} has {key} {base[key]}: not a pair"
            )


def _one_value(cells: pd.DataFrame, within: list[str], key: str, label: str) -> None:
    """Refuse cells that share the keys `within` and differ in `key`."""
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
    """Return the baselines that were planned, one row for each cell, indexed by its id."""
    planned = cells[(cells["label"] == BASELINE) & cells["cell_id"].notna()]
    return planned.drop_duplicates("cell_id").set_index("cell_id")


def _pairs(cells: pd.DataFrame, metrics: Sequence[Metric]) -> pd.DataFrame:
    """Return the pairs of finished cells; set in `cells` why an ablation is without one."""
    baselines = _baselines(cells)
    ablations = cells["label"] != BASELINE
    failed = baselines[baselines["state"] != "done"]
    unpaired = ablations & (cells["state"] == "done") & cells["baseline_id"].isin(failed.index)
    reasons = "no baseline: " + failed["reason"].astype(str)
    cells.loc[unpaired, "reason"] = cells.loc[unpaired, "baseline_id"].map(reasons).astype(str)
    paired = cells[ablations & (cells["state"] == "done") & ~unpaired]
    matched = baselines.loc[paired["baseline_id"]]
    parts = []
    for metric in metrics:
        baseline = matched[metric.name].to_numpy(np.float64)
        value = paired[metric.name].to_numpy(np.float64)
        change, why = percent_change(baseline, value)
        with np.errstate(invalid="ignore"):  # inf - inf gives NaN, as it should
            difference = value - baseline
        part = paired[[*_GROUP, "scene", "variant_seed", "seed", "cell_id", "baseline_id"]]
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


def _gaps(pairs: pd.DataFrame, cells: pd.DataFrame, metrics: Sequence[Metric]) -> pd.DataFrame:
    """Return the pairs of scores in conditions with all_hr, with the share of the gap as change."""
    scores = {m.name: m.higher_is_better for m in metrics if m.score is not None}
    conditions = cells.loc[cells["label"] == ALL_HR, "condition"].unique()
    rows = pairs[pairs["metric"].isin(scores) & pairs["condition"].isin(conditions)]
    replicate = ["condition", "baseline_id", "metric"]
    best = rows[rows["label"] == ALL_HR].drop_duplicates(replicate)[[*replicate, "value"]]
    rows = rows[rows["label"] != ALL_HR].merge(
        best.rename(columns={"value": ALL_HR}), on=replicate, how="left"
    )
    for name, higher_is_better in scores.items():
        of = rows["metric"] == name
        values = (rows.loc[of, key].to_numpy(np.float64) for key in ("baseline", "value", ALL_HR))
        share, why = share_of_gap(*values, higher_is_better=higher_is_better)
        rows.loc[of, "change"], rows.loc[of, "why"] = share, why
    return rows


def _averaged(pairs: pd.DataFrame) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Return the means of pairs over the replicates of each scene, and those over scenes."""
    per_scene = _summary(pairs, [*_GROUP, "scene", "metric"], unit="replicates")
    means = _over_scenes(per_scene)
    return _with_agreement(per_scene, pairs), _with_agreement(means, pairs)


def _with_agreement(means: pd.DataFrame, pairs: pd.DataFrame) -> pd.DataFrame:
    """Return the means with `pairs`, how many are behind each, and how many `agree` in sign."""
    by = list(means.index.names)
    known = pairs[pairs["change"].notna()]
    mean = known[by].merge(means["change"].reset_index(), on=by, how="left")["change"]
    agree = np.sign(known["change"].to_numpy()) == np.sign(mean.to_numpy())
    counts = known.assign(agree=agree).groupby(by)["agree"].agg(agree="sum", pairs="count")
    return means.join(counts).fillna({"agree": 0, "pairs": 0}).astype({"agree": int, "pairs": int})


def _summary(rows: pd.DataFrame, by: list[str], unit: str) -> pd.DataFrame:
    """Return mean and interval of the rows that share the keys `by`; `why` says what is missing."""
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
    incomplete = rows[rows["why"] != ""].drop_duplicates([*by, "why"])
    why = incomplete.groupby(by, sort=False)["why"].agg("; ".join)
    return table.assign(
        low=table["change"] - half,
        high=table["change"] + half,
        unit=unit,
        why=why.reindex(table.index).fillna(""),
    )


def _over_scenes(per_scene: pd.DataFrame) -> pd.DataFrame:
    """Return means over scenes; a single scene keeps its own interval, which is over replicates."""
    by = [*_GROUP, "metric"]
    rows = per_scene.reset_index()
    means = _summary(rows, by, unit="scenes")
    only = rows[rows["change"].notna()].drop_duplicates(by, keep=False).set_index(by)
    columns = ["spread", "n", "low", "high", "unit"]
    means.loc[only.index, columns] = only[columns]
    return means
