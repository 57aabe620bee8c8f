"""Builds the tables of a comparison: their rows and columns, and how a number is written."""

from __future__ import annotations

import math
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import pandas as pd

from xrgs.experiment.store import BASELINE
from xrgs.report.render import TextTable, titled

if TYPE_CHECKING:
    from collections.abc import Iterable

    from xrgs.evaluation.metrics import Metric
    from xrgs.report.compare import Comparison

#: An arrow means improvement or degradation, as in the paper's tables, not larger or smaller.
BETTER, WORSE, SAME = "↑", "↓", "="
#: Longest list of replicates in a title; of more it has the number.
_MAX_LISTED = 8
AGREEMENT_NOTE = "pairs that agree: pairs of one scene and replicate that change as their mean does"
#: Keys of a row of the long table.
_LEVEL = ["level", "label", "condition", "scene", "metric"]
#: Columns of the long table that have the share of the gap to all_hr, by their names elsewhere.
_GAP = {"change": "gap_closed_percent", "low": "gap_low", "high": "gap_high", "why": "gap_why"}
ARROWS_NOTE = f"{BETTER} improvement, {WORSE} degradation, {SAME} no change at this precision"


class Change(NamedTuple):
    """One row of `Comparison.means` or `Comparison.per_scene`: the fields are its columns."""

    baseline: float
    value: float
    change: float
    difference: float
    spread: float
    n: int
    low: float
    high: float
    unit: str
    why: str
    agree: int
    pairs: int


def number(value: float, unit: str) -> str:
    """Write a value with its unit, at a precision that fits its size.

    Args:
        value: The value; NaN is written as n/a.
        unit: Its unit, empty for none; bytes are written in MiB.
    """
    if math.isnan(value):
        return "n/a"
    if unit == "bytes":
        return f"{value / 2**20:,.1f} MiB"
    if math.isinf(value) or abs(value) >= 1000:
        text = f"{value:,.0f}"
    elif unit:
        text = f"{value:.2f}"
    else:
        text = f"{value:.4f}" if value % 1 else f"{value:.0f}"
    return f"{text} {unit}".rstrip()


def signed(value: float) -> str:
    """Write a number with two decimals and a sign, zero without sign.

    Args:
        value: The number; NaN is written as n/a.
    """
    if math.isnan(value):
        return "n/a"
    text = f"{value:+,.2f}"
    return "0.00" if text in {"+0.00", "-0.00"} else text


def arrow(change: float, metric: Metric) -> str:
    """Return whether the printed change is an improvement, in the metric's own direction.

    Args:
        change: The change in percent.
        metric: The metric that changed.

    Returns:
        `BETTER`, `WORSE`, `SAME` where the change is printed as 0.00, or a space for NaN.
    """
    if math.isnan(change):
        return " "
    if signed(change) == "0.00":
        return SAME
    return BETTER if (change > 0) == metric.higher_is_better else WORSE


def percent(change: float, metric: Metric) -> str:
    """Write a change as the paper's tables do: `-44.57 ↑`.

    Args:
        change: The change in percent.
        metric: The metric that changed.
    """
    return f"{signed(change)} {arrow(change, metric)}"


def reading(row: Change, metric: Metric) -> str:
    """Say in words what the interval shows.

    Args:
        row: The change with its interval.
        metric: The metric that changed.

    Returns:
        `better` or `worse` where the interval does not contain 0, `inside noise` where it does,
        `unchanged`, `one replicate: no interval`, or `n/a` with the reason.
    """
    if math.isnan(row.change):
        return f"n/a: {row.why}"
    if math.isnan(row.low):
        return "one replicate: no interval"
    if row.low <= 0 <= row.high and row.low < row.high:
        return "inside noise"
    if arrow(row.change, metric) == SAME:
        return "unchanged"
    return "better" if (row.change > 0) == metric.higher_is_better else "worse"


def interval(row: Change) -> str:
    """Write the 95 % interval of a change in percent, empty where there is none.

    Args:
        row: The change with its interval.
    """
    return "" if math.isnan(row.low) else f"{signed(row.low)} to {signed(row.high)}"


def agreement(row: Change) -> str:
    """Write how many of the pairs changed in the direction of their mean, `11 of 12`.

    Args:
        row: The change with the numbers of its pairs.
    """
    return f"{row.agree} of {row.pairs}" if row.pairs else ""


def interval_note(rows: Iterable[Change], *, one_each: bool) -> tuple[str, ...]:
    """Say what the intervals of a table are over; nothing where there are none.

    Args:
        rows: The changes in the table.
        one_each: Whether each scene has one replicate.
    """
    units = {row.unit for row in rows if not math.isnan(row.low)}
    if not units:
        return ()
    if "scenes" not in units:
        return ("interval: Student's t over the replicates",)
    alone = "; with one replicate, differences of runs and of scenes are mixed" * one_each
    return (f"interval: Student's t over the scenes' means{alone}",)


class Tables:
    """Builds every table of one comparison.

    Args:
        comparison: The pairs of cells and their means.
    """

    def __init__(self, comparison: Comparison) -> None:
        self.comparison = comparison

    @cached_property
    def _means(self) -> dict[tuple[str, ...], Change]:
        return by_key(self.comparison.means)

    @cached_property
    def _per_scene(self) -> dict[tuple[str, ...], Change]:
        return by_key(self.comparison.per_scene)

    @cached_property
    def _replicates(self) -> dict[tuple[str, str, str], set[tuple[int, int]]]:
        """The replicates (variant.seed, seed) of the pairs, by (label, condition, scene)."""
        pairs = self.comparison.pairs
        keys = zip(pairs["label"], pairs["condition"], pairs["scene"], strict=True)
        replicates: dict[tuple[str, str, str], set[tuple[int, int]]] = {}
        for key, *one in zip(keys, pairs["variant_seed"], pairs["seed"], strict=True):
            replicates.setdefault(key, set()).add((one[0], one[1]))
        return replicates

    def scenes_of(self, label: str, condition: str) -> list[str]:
        """Return the scenes with at least one pair of this label and condition."""
        return [s for s in self.comparison.scenes if (label, condition, s) in self._replicates]

    def overviews(self) -> list[TextTable]:
        """Return a table of all ablations for each condition that has several."""
        overviews = []
        for condition in dict.fromkeys(condition for _, condition in self.comparison.groups):
            labels = [name for name, other in self.comparison.groups if other == condition]
            if len(labels) > 1:
                overviews.append(self._overview(labels, condition))
        return overviews

    def _overview(self, labels: list[str], condition: str) -> TextTable:
        rows = tuple(
            (metric.label, *(self._cell(self._means.get((name, condition, metric.name)), metric)
                             for name in labels))
            for metric in self.comparison.metrics
        )  # fmt: skip
        return TextTable(
            title=titled("Change from baseline, %, mean over scenes", condition),
            columns=("Metric", *labels),
            rows=rows,
            align="l" + "r" * len(labels),
            notes=(ARROWS_NOTE,),
        )

    @staticmethod
    def _cell(row: Change | None, metric: Metric) -> str:
        return "failed  " if row is None else percent(row.change, metric)

    def mean(self, label: str, condition: str) -> TextTable:
        """Return the paper's Table 1 for one ablation, with values, intervals and what they show.

        Args:
            label: The ablation.
            condition: The condition that it was run under.
        """
        rows = []
        notes = [ARROWS_NOTE, AGREEMENT_NOTE]
        for metric in self.comparison.metrics:
            row = self._means.get((label, condition, metric.name))
            if row is None:
                continue
            rows.append(
                (
                    metric.label,
                    number(row.baseline, metric.unit),
                    number(row.value, metric.unit),
                    percent(row.change, metric),
                    signed(row.difference) if metric.unit == "dB" else "",
                    interval(row),
                    agreement(row),
                    reading(row, metric),
                )
            )
            if row.why and not math.isnan(row.change):
                notes.append(f"{metric.label}: pairs left out ({row.why})")
        return TextTable(
            title=titled(f"{label} against baseline: {self._extent(label, condition)}", condition),
            columns=(
                *("Metric", BASELINE, label, "change, %", "dB", "95 % interval, %"),
                *("pairs that agree", "reading"),
            ),
            rows=tuple(rows),
            align="lrrrrrrl",
            notes=(*notes, *self._interval_note(label, condition)) if rows else (),
        )

    def _extent(self, label: str, condition: str) -> str:
        """Say how many scenes and which replicates a mean is over."""
        scenes = self.scenes_of(label, condition)
        replicates = {one for s in scenes for one in self._replicates[label, condition, s]}
        of = "" if len(scenes) == len(self.comparison.scenes) else (
            f" of {len(self.comparison.scenes)}"
        )  # fmt: skip
        names = f"{len(scenes)}{of} scenes" if len(scenes) != 1 or of else f"scene {scenes[0]}"
        return f"{names}, {_listed(replicates)}"

    def _interval_note(self, label: str, condition: str) -> tuple[str, ...]:
        """Say what the intervals of a table are over; nothing where there are none."""
        found = (self._means.get((label, condition, m.name)) for m in self.comparison.metrics)
        scenes = self.scenes_of(label, condition)
        counts = {len(self._replicates[label, condition, s]) for s in scenes}
        return interval_note(filter(None, found), one_each=counts == {1})

    def per_scene(self, label: str, condition: str) -> TextTable:
        """Return a table with one column for each scene, failed ones too, and their mean.

        Args:
            label: The ablation.
            condition: The condition that it was run under.
        """
        scenes = self.comparison.scenes
        rows: list[tuple[str, ...]] = []
        for metric in self.comparison.metrics:
            found = [self._per_scene.get((label, condition, s, metric.name)) for s in scenes]
            mean = self._means.get((label, condition, metric.name))
            cells = [self._cell(row, metric) for row in (*found, mean)]
            rows.append((f"{metric.label}, %", *cells))
            if metric.unit == "dB":
                absolute = [
                    "failed  " if row is None else f"{signed(row.difference)}  "
                    for row in (*found, mean)
                ]
                rows.append((f"{metric.label}, dB", *absolute))
        return TextTable(
            title=titled(f"{label}: change from baseline, scene by scene", condition),
            columns=("Metric", *scenes, "mean"),
            rows=tuple(rows),
            align="l" + "r" * (len(scenes) + 1),
            notes=(ARROWS_NOTE,),
        )

    def values(self, condition: str) -> TextTable:
        """Return a table of each label's own values, means over the replicates that are done.

        Args:
            condition: The condition that the cells were run under.
        """
        cells = self.comparison.cells
        done = cells[(cells["state"] == "done") & (cells["condition"] == condition)]
        labels = list(dict.fromkeys(cells.loc[cells["condition"] == condition, "label"]))
        names = [metric.name for metric in self.comparison.metrics]
        means = done.groupby(["scene", "label"])[names].mean().to_dict("index")
        rows = []
        for scene in self.comparison.scenes:
            for metric in self.comparison.metrics:
                found = [means.get((scene, label)) for label in labels]
                texts = ["failed" if v is None else number(v[metric.name], metric.unit)
                         for v in found]  # fmt: skip
                rows.append((scene, metric.label, *texts))
        return TextTable(
            title=titled("Values, means over the replicates that are done", condition),
            columns=("Scene", "Metric", *labels),
            rows=tuple(rows),
            align="ll" + "r" * len(labels),
        )

    def missing(self) -> TextTable | None:
        """Return a table of the cells without results and why; None where there are none."""
        rows = self.comparison.missing()
        if rows.empty:
            return None
        keys = ["scene", "label", "condition", "variant_seed", "seed", "state", "reason"]
        return TextTable(
            title=f"{len(rows)} of {len(self.comparison.cells)} cells gave no number",
            columns=("Scene", "Label", "Condition", "variant.seed", "seed", "State", "Reason"),
            rows=tuple(tuple(map(str, row)) for row in rows[keys].itertuples(index=False)),
            align="lllrrll",
        )

    def long(self) -> pd.DataFrame:
        """Return every change at full precision, one in each row, as in `table.csv`."""
        metrics = {metric.name: metric for metric in self.comparison.metrics}
        scenes = self.comparison.per_scene.reset_index()
        means = self.comparison.means.reset_index()
        table = pd.concat([means.assign(level="mean", scene=""), scenes.assign(level="scene")])
        table = table.merge(self._long_gaps(), how="left", on=_LEVEL)
        rows = [Change(*row) for row in table[list(Change._fields)].itertuples(index=False)]
        of = [metrics[name] for name in table["metric"]]
        table["printed"] = [percent(r.change, m).rstrip() for r, m in zip(rows, of, strict=True)]
        table["reading"] = [reading(r, m) for r, m in zip(rows, of, strict=True)]
        table["metric_unit"] = [m.unit for m in of]
        table["higher_is_better"] = [m.higher_is_better for m in of]
        table = table.rename(columns={"n": "n_values", "unit": "n_of", "change": "change_percent"})
        return table[
            [*_LEVEL, "metric_unit", "higher_is_better",
             "baseline", "value", "change_percent", "difference", "low", "high", "spread",
             "n_values", "n_of", "agree", "pairs", "printed", "reading", "why", *_GAP.values()]
        ]  # fmt: skip

    def _long_gaps(self) -> pd.DataFrame:
        """Return the shares of the gap to all_hr, with the keys of `long`."""
        scenes = self.comparison.gaps_per_scene.reset_index().assign(level="scene")
        means = self.comparison.gaps.reset_index().assign(level="mean", scene="")
        return pd.concat([means, scenes])[[*_LEVEL, *_GAP]].rename(columns=_GAP)


def by_key(table: pd.DataFrame) -> dict[tuple[str, ...], Change]:
    """Return the rows of a table of means by their keys.

    Args:
        table: One of the tables of means of a `Comparison`.
    """
    rows = table[list(Change._fields)].itertuples(index=False)
    return {key: Change(*row) for key, row in zip(table.index, rows, strict=True)}


def _listed(replicates: set[tuple[int, int]]) -> str:
    """List the replicates of a mean; of many, say only how many there are.

    Args:
        replicates: Pairs (variant.seed, seed), which are named by `seed` where one draw of the HR
            views, and so one variant, is all that a scene has.
    """
    if len(replicates) > _MAX_LISTED:
        return f"{len(replicates)} replicates"
    several = "s" * (len(replicates) > 1)
    if len({draw for draw, _ in replicates}) == 1:
        return f"seed{several} " + ", ".join(str(seed) for _, seed in sorted(replicates))
    texts = (f"{draw}/{seed}" for draw, seed in sorted(replicates))
    return f"replicate{several} {', '.join(texts)} (variant.seed/seed)"
