"""Changes of each metric from a paired base, averaged by scene: the numbers of a report's tables.

The base is the baseline, or any other label of the sweep. A pair is a cell and the base of the same
scene, condition and replicate. A replicate is a value of `variant.seed`, which draws the HR views,
and a value of `seed`, which training uses: both cells of a pair have the same variant and seed.

Scores of views are compared by the change 100 (value - base) / |base|, as in the paper's Table 1.
Amounts (times, counts, memory) are compared by log(value / base). Their means and intervals become
percent at the end: 100 (exp(mean) - 1). A scene's change is the mean over its replicates, and the
sweep's change is the mean over scenes, in which each scene counts once.

Times are compared where both cells were trained on the same machine, with as many threads, and no
other machine continued either. A score is compared where the same code has computed both values.

The 95 % interval is Student's t around the mean. With several scenes it is over the scenes' means:
it says how far the mean would move with other scenes like these, and includes the noise between
replicates. With one scene it is over replicates. One scene with one replicate has no interval. The
tables also say how many of the pairs changed in the direction of the mean, and the standard
deviations of the replicates, pooled over the scenes, and of the scenes' means. The p of the t-test
that belongs to the interval gives Benjamini and Hochberg's q, over all ablations and metrics of a
condition.

A condition may have `all_hr`, which trains on the originals of the degraded photographs. A pair
then closes a share of the gap, 100 (value - base) / (all_hr - base), of the three cells of one
scene and replicate: 0 is the base, 100 is what no method can know. The shares are averaged in the
same way. A share needs all_hr to be better than the base, and is of scores of views alone: a gap in
seconds or Gaussians would mean nothing.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from xrgs.experiment.store import BASELINE
from xrgs.report.averages import averaged
from xrgs.report.collect import ReportError
from xrgs.report.inference import (
    ALL_HR,
    OTHER_CODE,
    OTHER_MACHINE,
    log_ratio,
    percent_change,
    share_of_gap,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from xrgs.evaluation.metrics import Metric

_GROUP = ["label", "condition"]
#: The units of the metrics that depend on the machine.
_TIMES = frozenset({"s", "ms"})
#: What a cell and the one that it is compared with have in common.
_PAIR = ["scene", "condition", "variant_seed", "seed"]


def is_amount(metric: Metric) -> bool:
    """Return whether a metric is an amount above zero (time, count, memory): compared by ratio."""
    return metric.score is None


@dataclass(frozen=True)
class Comparison:
    """Every number of a report's tables."""

    base: str
    """The label that all others are compared with."""
    metrics: tuple[Metric, ...]
    scenes: tuple[str, ...]
    """Names of the scenes, sorted."""
    groups: tuple[tuple[str, str], ...]
    """(label, condition) of each label but the base, in the sweep's order."""
    cells: pd.DataFrame
    """`Sweep.cells` with `base_id`, the cell that each is compared with, and `elsewhere`, whether
    another machine has trained that cell, as far as is known. The reason of an ablation without a
    finished base says so."""
    pairs: pd.DataFrame
    """One row for each metric of each ablation's cell: `base`, `value`, `effect` (the log of their
    ratio, or the change in %), `difference` (in the metric's unit) and `why` there is no effect."""
    per_scene: pd.DataFrame
    """Means over replicates, indexed by label, condition, scene, metric; its columns are described
    in `xrgs.report.averages.averaged`."""
    means: pd.DataFrame
    """Means over scenes, indexed by label, condition, metric."""
    gaps_per_scene: pd.DataFrame
    """As `per_scene`, with the share of the gap to all_hr (%) as the `change`: a row for each score
    and ablation in the conditions that have all_hr."""
    gaps: pd.DataFrame
    """As `means`, with the share of the gap as the `change`."""

    def missing(self) -> pd.DataFrame:
        """Return the cells without results, with `reason`, in the sweep's order."""
        return self.cells[self.cells["reason"] != ""]


def compare(cells: pd.DataFrame, metrics: Sequence[Metric], against: str = BASELINE) -> Comparison:
    """Pair every ablation with its base and average over replicates, then over scenes.

    Args:
        cells: The table `Sweep.cells`.
        metrics: The metrics to compare, in the order of the tables' rows. An optional one that no
            cell has is left out.
        against: The label that all others are compared with.

    Returns:
        The pairs, and their means over replicates and over scenes.

    Raises:
        ReportError: The sweep has no such label; a cell's baseline is of another scene, variant or
            seed, or is not in the sweep; cells of one scene, condition and `variant.seed` are of
            different variants; the cells were scored by different evaluation protocols; or some
            cells of a condition were scored on held-out training views and others were not. The
            message names both cells, or the labels.
    """
    metrics = [m for m in metrics if not m.optional or cells[m.name].notna().any()]
    cells = _with_base(cells, against)
    _check_comparable(cells, against)
    pairs = _pairs(cells, metrics, against)
    amounts = [metric.name for metric in metrics if is_amount(metric)]
    per_scene, means = averaged(pairs, amounts)
    gaps_per_scene, gaps = averaged(_gaps(pairs, cells, metrics, against), ())
    ablations = cells[cells["label"] != against]
    return Comparison(
        base=against,
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


def _with_base(cells: pd.DataFrame, against: str) -> pd.DataFrame:
    """Return the cells with `base_id` and `elsewhere`, as `Comparison.cells` has them.

    The record names the baseline; any other base is found by scene, condition and replicate.
    """
    if against == BASELINE:
        base_id = cells["baseline_id"]
    else:
        labels = list(dict.fromkeys(cells["label"]))
        if against not in labels:
            raise ReportError(
                f"against={against}: the sweep has no such label; choose from: {', '.join(labels)}"
            )
        bases = cells[cells["label"] == against].drop_duplicates(_PAIR).set_index(_PAIR)
        base_id = cells[_PAIR].join(bases["cell_id"], on=_PAIR)["cell_id"]
    base_id = base_id.where(cells["label"] != against, cells["cell_id"])
    machines = cells.drop_duplicates("cell_id").set_index("cell_id")["machine"]
    machine, of_base = cells["machine"], base_id.map(machines).astype(object).fillna("")
    elsewhere = (machine != of_base) & (machine != "") & (of_base != "")
    return cells.assign(base_id=base_id, elsewhere=elsewhere)


def _check_comparable(cells: pd.DataFrame, against: str) -> None:
    """Raise ReportError for cells that can't be compared; `compare` lists the reasons."""
    done = cells[cells["state"] == "done"]
    _one_value(done, [], "protocol", "evaluation protocol")
    _one_value(done, ["condition"], "validation", "train.validation value")
    draw = ["scene", "condition", "variant_seed"]
    _one_value(cells.dropna(subset="variant_id"), draw, "variant_id", "variant")
    planned = cells["cell_id"].notna() & cells["base_id"].notna()
    ablations = cells[(cells["label"] != against) & planned]
    bases = _bases(cells, against)
    unknown = ablations[~ablations["base_id"].isin(bases.index)]
    if not unknown.empty:
        row = unknown.iloc[0]
        raise ReportError(
            f"cell {row['cell_id']} ({_name(row)}): its {against} {row['base_id']} "
            "is not in the sweep"
        )
    matched = bases.loc[ablations["base_id"]]
    _check_pairs(ablations, matched, ("scene", "variant_id", "seed"))
    scored = ablations["validation"].notna().to_numpy() & matched["validation"].notna().to_numpy()
    _check_pairs(ablations[scored], matched[scored], ("validation",))


def _check_pairs(ablations: pd.DataFrame, matched: pd.DataFrame, keys: Sequence[str]) -> None:
    """Refuse an ablation that differs in a key from its base, the row of `matched` beside it."""
    for key in keys:
        differs = ablations[key].to_numpy() != matched[key].to_numpy()
        if differs.any():
            at = int(np.argmax(differs))
            cell, base = ablations.iloc[at], matched.iloc[at]
            raise ReportError(
                f"cell {cell['cell_id']} ({_name(cell)}) has {key} {cell[key]}, "
                f"its {base['label']} {cell['base_id']} has {key} {base[key]}: not a pair"
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


def _bases(cells: pd.DataFrame, against: str) -> pd.DataFrame:
    """Return the planned cells of the base, one row for each, indexed by its id."""
    planned = cells[(cells["label"] == against) & cells["cell_id"].notna()]
    return planned.drop_duplicates("cell_id").set_index("cell_id")


def _pairs(cells: pd.DataFrame, metrics: Sequence[Metric], against: str) -> pd.DataFrame:
    """Return the pairs of finished cells; set in `cells` why an ablation is without one."""
    bases = _bases(cells, against)
    ablations = cells[(cells["label"] != against) & (cells["state"] == "done")]
    usable = ablations["base_id"].isin(bases.index[bases["state"] == "done"])
    reasons = ablations.loc[~usable, "base_id"].map(bases["reason"].astype(str))
    reasons = reasons.fillna("not planned for its scene, condition and replicate").astype(str)
    cells.loc[reasons.index, "reason"] = f"no {against}: " + reasons
    paired = ablations[usable]
    matched = bases.loc[paired["base_id"]]
    parts = []
    for metric in metrics:
        base = matched[metric.name].to_numpy(np.float64)
        value = paired[metric.name].to_numpy(np.float64)
        effect, why = (log_ratio if is_amount(metric) else percent_change)(base, value)
        incomparable, reason = _incomparable(metric, paired, matched)
        effect = np.where(incomparable, np.nan, effect)
        why = np.where(incomparable & (why == ""), reason, why)
        with np.errstate(invalid="ignore"):  # inf - inf gives NaN, as it should
            difference = value - base
        part = paired[[*_GROUP, "scene", "variant_seed", "seed", "cell_id", "base_id"]]
        parts.append(
            part.assign(
                metric=metric.name,
                base=base,
                value=value,
                effect=effect,
                difference=difference,
                why=why,
            )
        )
    return pd.concat(parts, ignore_index=True)


def _incomparable(
    metric: Metric, paired: pd.DataFrame, matched: pd.DataFrame
) -> tuple[NDArray[np.bool_], str]:
    """Return which pairs have values of a metric that can't be compared, and why."""
    if not is_amount(metric):
        code = f"{metric.name}_code"
        return paired[code].to_numpy(str) != matched[code].to_numpy(str), OTHER_CODE
    return paired["elsewhere"].to_numpy(bool) & (metric.unit in _TIMES), OTHER_MACHINE


def _gaps(
    pairs: pd.DataFrame, cells: pd.DataFrame, metrics: Sequence[Metric], against: str
) -> pd.DataFrame:
    """Return the pairs of scores in conditions with all_hr; the effect is the share of the gap."""
    scores = {m.name: m.higher_is_better for m in metrics if not is_amount(m)}
    conditions = cells.loc[cells["label"].isin({ALL_HR} - {against}), "condition"].unique()
    rows = pairs[pairs["metric"].isin(scores) & pairs["condition"].isin(conditions)]
    replicate = ["condition", "base_id", "metric"]
    comparable = rows[rows["why"] != OTHER_CODE]
    best = comparable[comparable["label"] == ALL_HR].drop_duplicates(replicate)
    best = best[[*replicate, "value"]].rename(columns={"value": ALL_HR})
    rows = rows[rows["label"] != ALL_HR].merge(best, on=replicate, how="left")
    for name, higher_is_better in scores.items():
        of = rows["metric"] == name
        values = (rows.loc[of, key].to_numpy(np.float64) for key in ("base", "value", ALL_HR))
        share, why = share_of_gap(*values, higher_is_better=higher_is_better)
        scored_otherwise = rows.loc[of, "why"] == OTHER_CODE
        rows.loc[of, "effect"] = np.where(scored_otherwise, np.nan, share)
        rows.loc[of, "why"] = np.where(scored_otherwise, OTHER_CODE, why)
    return rows
