"""Changes of each metric from a paired base, averaged by scene: the numbers of a report's tables.

docs/statistics.md defines changes, intervals, tests, verdicts and the share of the gap to `all_hr`.
A pair is a cell and the base of the same scene, condition and replicate (`variant.seed` and
`seed`), so that both have the same variant and seed. The base is the baseline, or any other label
of the sweep.

Times are compared if both cells were trained on the same machine and number of threads from start
to end. A score is compared if the same code has computed both values. Shares of the gap exist only
for scores of views, since a gap in seconds or Gaussians means nothing.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from xrgs.evaluation.metrics import Metric
from xrgs.report.averages import averaged
from xrgs.report.collect import ReportError
from xrgs.report.inference import (
    ALL_HR,
    OTHER_CODE,
    OTHER_MACHINE,
    OTHER_THREADS,
    Floats,
    difference,
    equivalence,
    false_discovery_rates,
    holm,
    log_ratio,
    share_of_gap,
)
from xrgs.store.provenance import without_threads
from xrgs.store.store import BASELINE

_GROUP = ["label", "condition"]
#: The units of the metrics that depend on the machine.
_TIMES = frozenset({"s", "ms"})
#: The keys of a run, which has a cell for each label: a cell and its base agree in them.
RUN = ["scene", "condition", "variant_seed", "seed"]
#: The columns of a pair that are computed of its two cells.
_VALUES = ("base", "value", "effect", "why")


@dataclass(frozen=True)
class Design:
    """The outcomes and margins of a comparison, which a study names before it has the data."""

    outcomes: tuple[str, ...] = (
        *("psnr", "psnr_pooled", "psnr_worst", "lpips"),
        *("evaluations", "gaussians"),
    )
    """Names of the metrics that have a verdict, in the order of the tables."""
    headline: tuple[str, ...] = ()
    """Labels about which a study makes its claims: their tests are corrected by Holm."""
    margin_psnr: float = 0.2
    """The largest change of PSNR that counts as none, dB; our choice."""
    margin_lpips: float = 5.0
    """The largest change of LPIPS that counts as none, %; our choice."""

    def __post_init__(self) -> None:
        for name in ("margin_psnr", "margin_lpips"):
            if not (margin := getattr(self, name)) >= 0 or math.isinf(margin):
                raise ReportError(f"{name}={margin:g}: must be a number of at least 0")

    def margin(self, metric: Metric) -> float:
        """Return the margin of a metric in the unit of its effect; 0 if it has none."""
        if metric.unit == "dB":
            return self.margin_psnr
        is_lpips = metric.name in {"lpips", "lpips_vgg"}
        return float(np.log1p(self.margin_lpips / 100)) if is_lpips else 0.0


def scored_by(metric: Metric) -> str:
    """Return the name of the score from which a metric is computed; empty for an amount."""
    if metric.score is None:
        return "psnr" if metric.unit == "dB" else ""
    return metric.name


def is_ratio(metric: Metric) -> bool:
    """Return whether changes of a metric are ratios, shown in percent; else differences in dB."""
    return metric.unit != "dB"


@dataclass(frozen=True)
class Comparison:
    """Every number of a report's tables."""

    design: Design
    base: str
    """The label that all others are compared with."""
    metrics: tuple[Metric, ...]
    scenes: tuple[str, ...]
    """Names of the scenes, sorted."""
    groups: tuple[tuple[str, str], ...]
    """(label, condition) of all labels except the base, in the sweep's order."""
    cells: pd.DataFrame
    """`Sweep.cells` with two more columns: `base_id`, the cell that each is compared with, and
    `elsewhere`, the reason if their times can't be compared (another machine or number of threads),
    else empty. The `reason` of an ablation without a finished base says so."""
    pairs: pd.DataFrame
    """One row for each metric of each ablation's cell: `base`, `value`, `effect` (their difference
    in dB, or the logarithm of their ratio) and `why`, the reason if there is no effect."""
    per_scene: pd.DataFrame
    """Means over replicates, indexed by label, condition, scene, metric; its columns are described
    in `xrgs.report.averages.averaged`."""
    means: pd.DataFrame
    """Means over scenes, indexed by label, condition, metric. An `outcome` also has corrected
    tests: `q` (Benjamini and Hochberg), `holm` for headline labels, `p_equivalent` (TOST)."""
    gaps_per_scene: pd.DataFrame
    """As `per_scene`, with the share of the gap to all_hr (%) as the `change`: a row for each score
    and ablation in the conditions that have all_hr."""
    gaps: pd.DataFrame
    """As `means`, with the share of the gap as the `change`."""

    def missing(self) -> pd.DataFrame:
        """Return the cells without results, with `reason`, in the sweep's order."""
        return self.cells[self.cells["reason"] != ""]


def compare(
    cells: pd.DataFrame,
    metrics: Sequence[Metric],
    against: str = BASELINE,
    design: Design | None = None,
) -> Comparison:
    """Pair every ablation with its base and average over replicates, then over scenes.

    Args:
        cells: The table `Sweep.cells`.
        metrics: The metrics to compare. An optional one that no cell has is left out. Outcomes come
            first in the tables, and the others follow in this order.
        against: The label that all others are compared with.
        design: The outcomes, headline labels and margins; None takes the defaults.

    Returns:
        The pairs, and their means over replicates and over scenes.

    Raises:
        ReportError: The sweep has no such label, or its cells no such metric; a cell's baseline is
            of another scene, variant or seed, or is not in the sweep; cells of one scene, condition
            and `variant.seed` are of different variants; the cells were scored by different
            evaluation protocols; or some cells of a condition were scored on held-out training
            views and others were not. The message names both cells, or what to choose from.
    """
    design = design or Design()
    order = {name: at for at, name in enumerate(design.outcomes)}
    metrics = sorted(
        (m for m in metrics if not m.optional or cells[m.name].notna().any()),
        key=lambda metric: order.get(metric.name, len(order)),
    )
    _check_design(design, metrics, cells)
    cells = _with_base(cells, against)
    _check_comparable(cells, against)
    pairs = _pairs(cells, metrics, against)
    per_scene, means = averaged(pairs, [metric.name for metric in metrics if is_ratio(metric)])
    gaps_per_scene, gaps = averaged(_gaps(pairs, cells, metrics, against), ())
    ablations = cells[cells["label"] != against]
    return Comparison(
        design=design,
        base=against,
        metrics=tuple(metrics),
        scenes=tuple(sorted(cells["scene"].unique())),
        groups=tuple(dict.fromkeys(zip(ablations["label"], ablations["condition"], strict=True))),
        cells=cells,
        pairs=pairs,
        per_scene=per_scene,
        means=_tested(means, metrics, design),
        gaps_per_scene=gaps_per_scene,
        gaps=gaps,
    )


def _check_design(design: Design, metrics: Sequence[Metric], cells: pd.DataFrame) -> None:
    """Refuse an outcome that is no metric of the cells, and a headline that is no label."""
    for key, kind, wanted, choices in (
        ("outcomes", "metric", design.outcomes, [metric.name for metric in metrics]),
        ("headline", "label", design.headline, list(dict.fromkeys(cells["label"]))),
    ):
        if unknown := [name for name in wanted if name not in choices]:
            raise ReportError(
                f"{key}={unknown[0]}: these cells have no such {kind}; choose from:"
                f" {', '.join(choices)}"
            )


def _tested(means: pd.DataFrame, metrics: Sequence[Metric], design: Design) -> pd.DataFrame:
    """Return the means with the corrected tests of the outcomes, see `Comparison.means`."""
    by_name = {metric.name: metric for metric in metrics}
    rows = [by_name[name] for name in means.index.get_level_values("metric")]
    outcome = np.array([metric.name in design.outcomes for metric in rows], dtype=bool)
    headline = means.index.get_level_values("label").isin(design.headline)
    amount = np.array([not scored_by(metric) for metric in rows], dtype=bool)
    families = [means.index.get_level_values("condition"), amount]
    margin = np.array([design.margin(metric) for metric in rows], dtype=np.float64)
    effect, spread, n = (means[name].to_numpy(np.float64) for name in ("effect", "spread", "n"))

    def corrected(chosen: NDArray[np.bool_], correct: Callable[[Floats], Floats]) -> pd.Series:
        p = means["p"].where(chosen)
        return p.groupby(families).transform(lambda group: correct(group.to_numpy(np.float64)))

    return means.assign(
        outcome=outcome,
        q=corrected(outcome, false_discovery_rates),
        holm=corrected(outcome & headline, holm),
        p_equivalent=np.where(outcome, equivalence(effect, spread, n, margin), np.nan),
    )


def _with_base(cells: pd.DataFrame, against: str) -> pd.DataFrame:
    """Return the cells with `base_id` and `elsewhere`, see `Comparison.cells`.

    A base is found by scene, condition and replicate. The record names the baseline, unless the
    sweep has none (`baseline=false`) and is joined with one that has it.
    """
    labels = list(dict.fromkeys(cells["label"]))
    if against not in {*labels, BASELINE}:
        raise ReportError(
            f"against={against}: the sweep has no such label; choose from: {', '.join(labels)}"
        )
    bases = cells[cells["label"] == against].drop_duplicates(RUN).set_index(RUN)
    base_id = cells[RUN].join(bases["cell_id"], on=RUN)["cell_id"]
    if against == BASELINE:
        base_id = cells["baseline_id"].where(cells["baseline_id"].notna(), base_id)
    base_id = base_id.where(cells["label"] != against, cells["cell_id"])
    machines = cells.drop_duplicates("cell_id").set_index("cell_id")["machine"]
    machine, base_machine = cells["machine"], base_id.map(machines).astype(object).fillna("")
    pairs = zip(machine, base_machine, strict=True)
    elsewhere = pd.Series([_elsewhere(*pair) for pair in pairs], cells.index, object)
    return cells.assign(base_id=base_id, elsewhere=elsewhere)


def _elsewhere(machine: str, base: str) -> str:
    """Return why times of two machines (`provenance.machine`) can't be compared; else empty."""
    if machine == base or not (machine and base):
        return ""
    same_machine = without_threads(machine) == without_threads(base)
    return OTHER_THREADS if same_machine else OTHER_MACHINE


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
            f"cell {row['cell_id']} ({run_name(row)}): its {against} {row['base_id']} "
            "is not in the sweep"
        )
    matched = bases.loc[ablations["base_id"]]
    _check_pairs(ablations, matched, ("scene", "variant_id", "seed"))
    scored = ablations["validation"].notna().to_numpy() & matched["validation"].notna().to_numpy()
    _check_pairs(ablations[scored], matched[scored], ("validation",))


def _check_pairs(ablations: pd.DataFrame, matched: pd.DataFrame, keys: Sequence[str]) -> None:
    """Refuse an ablation that differs in a key from its base, the same row of `matched`."""
    for key in keys:
        differs = ablations[key].to_numpy() != matched[key].to_numpy()
        if differs.any():
            at = int(np.argmax(differs))
            cell, base = ablations.iloc[at], matched.iloc[at]
            raise ReportError(
                f"cell {cell['cell_id']} ({run_name(cell)}) has {key} {cell[key]}, "
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
        f"{first['cell_id']} ({run_name(first)}) has {first[key]}, "
        f"{second['cell_id']} ({run_name(second)}) has {second[key]}"
    )


def run_name(cell: pd.Series) -> str:
    """Return scene, label, condition and seed of a row of `Comparison.cells` or `pairs`."""
    parts = (cell["scene"], cell["label"], cell["condition"], f"seed {cell['seed']}")
    return ", ".join(str(part) for part in parts if part)


def _bases(cells: pd.DataFrame, against: str) -> pd.DataFrame:
    """Return the base's planned cells, one row each, indexed by the cell's id."""
    planned = cells[(cells["label"] == against) & cells["cell_id"].notna()]
    return planned.drop_duplicates("cell_id").set_index("cell_id")


def _pairs(cells: pd.DataFrame, metrics: Sequence[Metric], against: str) -> pd.DataFrame:
    """Return the pairs of finished cells; set `reason` in `cells` for ablations without a base."""
    bases = _bases(cells, against)
    ablations = cells[(cells["label"] != against) & (cells["state"] == "done")]
    usable = ablations["base_id"].isin(bases.index[bases["state"] == "done"])
    reasons = ablations.loc[~usable, "base_id"].map(bases["reason"].astype(str))
    reasons = reasons.fillna("not planned for its scene, condition and replicate").astype(str)
    cells.loc[reasons.index, "reason"] = f"no {against}: " + reasons
    paired = ablations[usable]
    matched = bases.loc[paired["base_id"]]
    columns: dict[str, list[Any]] = {key: [] for key in ("metric", *_VALUES)}
    for metric in metrics:
        base = matched[metric.name].to_numpy(np.float64)
        value = paired[metric.name].to_numpy(np.float64)
        effect, why = (log_ratio if is_ratio(metric) else difference)(base, value)
        incomparable, reason = _incomparable(metric, paired, matched)
        effect = np.where(incomparable, np.nan, effect)
        why = np.where(incomparable & (why == ""), reason, why)
        columns["metric"] += [metric.name] * len(paired)
        for name, of in zip(_VALUES, (base, value, effect, why), strict=True):
            columns[name] += of.tolist()
    keys = paired[[*_GROUP, "scene", "variant_seed", "seed", "cell_id", "base_id"]]
    pairs = pd.concat([keys] * len(metrics), ignore_index=True).assign(**columns)
    return pairs.astype({"metric": str, "why": str})  # if there are none too


def _incomparable(
    metric: Metric, paired: pd.DataFrame, matched: pd.DataFrame
) -> tuple[NDArray[np.bool_], str | NDArray[np.str_]]:
    """Return for which pairs a metric can't be compared, and the reason."""
    if score := scored_by(metric):
        code = f"{score}_code"
        return paired[code].to_numpy(str) != matched[code].to_numpy(str), OTHER_CODE
    why = paired["elsewhere"].to_numpy(str)
    return (why != "") & (metric.unit in _TIMES), why


def _gaps(
    pairs: pd.DataFrame, cells: pd.DataFrame, metrics: Sequence[Metric], against: str
) -> pd.DataFrame:
    """Return the pairs of scores in conditions with all_hr; `effect` is the share of the gap, %."""
    scores = {m.name: m.higher_is_better for m in metrics if m.score is not None}
    conditions = cells.loc[cells["label"].isin({ALL_HR} - {against}), "condition"].unique()
    if not conditions.size:  # as in most studies
        return pairs.iloc[:0]
    rows = pairs[pairs["metric"].isin(scores) & pairs["condition"].isin(conditions)]
    replicate = ["condition", "base_id", "metric"]
    comparable = rows[rows["why"] != OTHER_CODE]
    best = comparable[comparable["label"] == ALL_HR].drop_duplicates(replicate)
    best = best[[*replicate, "value"]].rename(columns={"value": ALL_HR})
    rows = rows[rows["label"] != ALL_HR].merge(best, on=replicate, how="left")
    for name, higher_is_better in scores.items():
        mask = rows["metric"] == name
        values = (rows.loc[mask, key].to_numpy(np.float64) for key in ("base", "value", ALL_HR))
        share, why = share_of_gap(*values, higher_is_better=higher_is_better)
        scored_otherwise = rows.loc[mask, "why"] == OTHER_CODE
        rows.loc[mask, "effect"] = np.where(scored_otherwise, np.nan, share)
        rows.loc[mask, "why"] = np.where(scored_otherwise, OTHER_CODE, why)
    return rows
