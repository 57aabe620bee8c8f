"""Builds the tables of a comparison: their rows and columns."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import cached_property

import numpy as np
import pandas as pd

from xrgs.evaluation.metrics import Metric
from xrgs.report.compare import Comparison
from xrgs.report.context import Context
from xrgs.report.inference import ALL_HR
from xrgs.report.markup import filled, titled
from xrgs.report.writing import (
    MISSING,
    NO_INTERVAL,
    SAME,
    Change,
    by_key,
    change_unit,
    interval,
    lacking,
    marked,
    named,
    number,
    p_value,
    pointed,
    same_sign,
    signed,
    verdict,
    with_unit,
)
from xrgs.runtime.text import TextTable

#: Metrics that differ between two runs of the same training.
_NOISY = frozenset({"training_time_s", "render_time_ms", "peak_rss_bytes"})
#: The longest reason inside a table, in characters.
_MAX_REASON = 100
#: The most replicates that a title lists; of more it says only the number.
_MAX_LISTED = 8
#: The order of the scores in a compact table and the arrows in its heads, as in papers.
_PAPER_ORDER = {"psnr": 0, "ssim": 1, "lpips": 2}
_DIRECTION = {True: "↑", False: "↓"}
#: Keys of a row of the long table.
_LEVEL = ["level", "label", "condition", "scene", "metric"]
#: Names in the averages -> columns of the long table, for the share of the gap that is closed.
_GAP = {"change": "gap_closed_percent", "low": "gap_low", "high": "gap_high", "why": "gap_why"}


class Tables:
    """Builds the tables of one comparison."""

    def __init__(
        self,
        comparison: Comparison,
        contexts: Mapping[str, Context] | None = None,
        notes: Mapping[tuple[str, str], Sequence[str]] | None = None,
    ) -> None:
        self.comparison = comparison
        self.contexts = contexts or {}
        self._notes = notes or {}

    @property
    def cautions(self) -> tuple[str, ...]:
        """The cautions of all conditions, each sentence once."""
        return tuple(dict.fromkeys(text for one in self.contexts.values() for text in one.cautions))

    def _context(self, condition: str) -> Context:
        return self.contexts.get(condition, Context())

    @cached_property
    def _means(self) -> dict[tuple[str, ...], Change]:
        return by_key(self.comparison.means)

    @cached_property
    def _per_scene(self) -> dict[tuple[str, ...], Change]:
        return by_key(self.comparison.per_scene)

    @cached_property
    def _replicates(self) -> dict[tuple[str, str, str], set[tuple[int, int]]]:
        """(label, condition, scene) -> the replicates (variant.seed, seed) of its pairs."""
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
        """Return a table of all ablations for each condition with several ablations."""
        overviews = []
        for condition in dict.fromkeys(condition for _, condition in self.comparison.groups):
            labels = [name for name, other in self.comparison.groups if other == condition]
            if len(labels) > 1:
                overviews.append(self._overview(labels, condition))
        return overviews

    def _overview(self, labels: list[str], condition: str) -> TextTable:
        base, scenes = self.comparison.base, len(self.comparison.scenes)
        outcomes = [m for m in self.comparison.metrics if m.name in self.comparison.design.outcomes]
        same = {name: why for name in labels if (why := self.unchanged(name, condition))}
        rows = tuple(
            (name, *(SAME if name in same else
                     marked(self._means.get((name, condition, metric.name)), metric, scenes)
                     for metric in outcomes))
            for name in labels
        )  # fmt: skip
        return TextTable(
            title=titled(f"Change from {base}, mean over scenes", condition),
            columns=("Ablation", *map(named, outcomes)),
            rows=rows,
            align="l" + "r" * len(outcomes),
            notes=(
                *self._context(condition).cautions,
                *(f"{name} {why}" for name, why in same.items()),
            ),
            context=self._context(condition).of_all,
            name=f"overview {condition}".strip(),
        )

    def unchanged(self, label: str, condition: str) -> str:
        """Say why an ablation has nothing to compare: its cells or results are those of the base.

        It is the end of a sentence that begins with the label, and empty if something changed.
        Times and the memory of the process don't count, since they differ in every run.
        """
        pairs, base = self.comparison.pairs, self.comparison.base
        own_pairs = pairs[(pairs["label"] == label) & (pairs["condition"] == condition)]
        if own_pairs.empty:
            return ""
        if (own_pairs["cell_id"] == own_pairs["base_id"]).all():
            return f"changes nothing: its cells are the cells of {base}"
        steady = own_pairs[~own_pairs["metric"].isin(_NOISY)]
        measured = steady[steady["base"].notna() | steady["value"].notna()]
        if measured.empty or not (measured["base"] == measured["value"]).all():
            return ""
        return f"changes nothing: its scores, counts and amounts of work are those of {base}"

    def mean(self, label: str, condition: str) -> TextTable:
        """Return the changes of one ablation, with values, intervals and verdicts."""
        base, scenes = self.comparison.base, len(self.scenes_of(label, condition))
        keys = ((label, condition, metric.name) for metric in self.comparison.metrics)
        changes = [
            (self._means[key], metric)
            for key, metric in zip(keys, self.comparison.metrics, strict=True)
            if key in self._means
        ]
        title = titled(f"{label} against {base}: {self._extent(label, condition)}", condition)
        if why := self.unchanged(label, condition):
            return TextTable(title, ("Result",), ((f"{label} {why}",),), "l")
        # A verdict that all rows share is said once, in the context.
        shared = NO_INTERVAL if all(math.isnan(row.low) for row, _ in changes) else ""
        replicates = [
            self._replicates[label, condition, s] for s in self.scenes_of(label, condition)
        ]
        is_mixed = scenes > 1 and all(len(of_scene) == 1 for of_scene in replicates)
        corrected = "p (Holm)" if label in self.comparison.design.headline else "q"
        table = TextTable(
            title=title,
            columns=(
                *("Metric", base, label, "change", "95 % interval", "new scene"),
                *("same sign (p)", corrected, "verdict"),
            ),
            rows=tuple(_mean_row(row, metric, scenes, shared) for row, metric in changes),
            align="lrrrrrrrl",
            notes=(
                *(*self._context(condition).cautions, *self._notes.get((label, condition), ())),
                *(
                    f"{metric.label}: pairs left out ({row.why})"
                    for row, metric in changes
                    if row.why and not math.isnan(row.change)
                ),
                *["one replicate a scene: differences of runs and of scenes are mixed"] * is_mixed,
            ),
            context="; ".join(filter(None, (shared, self._context(condition).of_all))),
            name=f"{label} {condition}".strip(),
        )
        return filled(table)

    def _extent(self, label: str, condition: str) -> str:
        """Name the number of scenes and the replicates of a mean."""
        scenes = self.scenes_of(label, condition)
        replicates = {one for s in scenes for one in self._replicates[label, condition, s]}
        of = "" if len(scenes) == len(self.comparison.scenes) else (
            f" of {len(self.comparison.scenes)}"
        )  # fmt: skip
        names = f"{len(scenes)}{of} scenes" if len(scenes) != 1 or of else f"scene {scenes[0]}"
        return f"{names}, {_listed(replicates)}"

    def per_scene(self, label: str, condition: str) -> TextTable:
        """Return a table with a column for each scene, including failed ones, and their mean."""
        scenes = self.comparison.scenes
        rows: list[tuple[str, ...]] = []
        for metric in () if self.unchanged(label, condition) else self.comparison.metrics:
            changes = [self._per_scene.get((label, condition, s, metric.name)) for s in scenes]
            mean = self._means.get((label, condition, metric.name))
            if not any(changes):  # no cell is done: see the table `missing`
                continue
            cells = [
                *(MISSING if row is None else pointed(row.change, metric) for row in changes),
                marked(mean, metric, len(scenes)),
            ]
            rows.append((named(metric), *cells))
        return TextTable(
            title=titled(f"{label}: change from {self.comparison.base}, scene by scene", condition),
            columns=("Metric", *scenes, "mean"),
            rows=tuple(rows),
            align="l" + "r" * (len(scenes) + 1),
            notes=self._context(condition).cautions,
            context=self._context(condition).of_all,
            name=f"scenes {label} {condition}".strip(),
        )

    def values(self, condition: str) -> TextTable:
        """Return a table of each label's values, means over the done replicates.

        A scene without a done cell has no rows: see the table `missing`.
        """
        cells = self.comparison.cells
        done = cells[(cells["state"] == "done") & (cells["condition"] == condition)]
        labels = list(dict.fromkeys(cells.loc[cells["condition"] == condition, "label"]))
        names = [metric.name for metric in self.comparison.metrics]
        means = done.groupby(["scene", "label"])[names].mean().to_dict("index")
        rows = []
        for scene in sorted(done["scene"].unique()):
            for metric in self.comparison.metrics:
                numbers = [means.get((scene, label)) for label in labels]
                texts = [MISSING if v is None else number(v[metric.name], metric.unit)
                         for v in numbers]  # fmt: skip
                rows.append((scene, metric.label, *texts))
        return TextTable(
            title=titled("Values, means over the replicates that are done", condition),
            columns=("Scene", "Metric", *labels),
            rows=tuple(rows),
            align="ll" + "r" * len(labels),
            notes=self._context(condition).cautions,
            context=self._context(condition).of_all,
            name=f"values {condition}".strip(),
        )

    def scores(self, condition: str) -> TextTable:
        """Return a compact table as in papers: a row for each method, the scores scene by scene.

        The scores are means over the done replicates. With several scenes there is a mean over all
        of them, n/a for a method that lacks one. The best of each column is bold.
        """
        cells = self.comparison.cells
        here = cells[cells["condition"] == condition]
        labels = list(dict.fromkeys(here["label"]))
        metrics = [metric for metric in self.comparison.metrics if metric.score is not None]
        metrics.sort(key=lambda metric: _PAPER_ORDER.get(metric.name, len(_PAPER_ORDER)))
        done = here[here["state"] == "done"]
        names = [metric.name for metric in metrics]
        means = done.groupby(["label", "scene"])[names].mean().to_dict("index")
        columns = [(scene, metric) for scene in self.comparison.scenes for metric in metrics]
        values = {
            label: [means.get((label, scene), {}).get(m.name, math.nan) for scene, m in columns]
            for label in labels
        }
        if len(self.comparison.scenes) > 1:
            columns += [("mean", metric) for metric in metrics]
            for row in values.values():
                row += [float(np.mean(row[first :: len(metrics)])) for first in range(len(metrics))]
        texts = [[_score(v, m) for v, (_, m) in zip(values[label], columns, strict=True)]
                 for label in labels]  # fmt: skip
        best = {
            (row, column + 1)
            for column, (_, metric) in enumerate(columns)
            for row in _best([values[label][column] for label in labels], metric)
        }
        heads = [f"{metric.label} {_DIRECTION[metric.higher_is_better]}" for _, metric in columns]
        spans = [(scene, len(metrics)) for scene in dict.fromkeys(scene for scene, _ in columns)]
        return TextTable(
            title=titled("Scores by method and scene, means over replicates", condition),
            columns=("Method", *heads),
            rows=tuple((label, *row) for label, row in zip(labels, texts, strict=True)),
            align="l" + "r" * len(columns),
            notes=(f"{_DIRECTION[True]} higher is better, {_DIRECTION[False]} lower is better",
                   *self._context(condition).cautions),
            context=self._context(condition).of_scores,
            name=f"scores {condition}".strip(),
            spans=(("", 1), *spans),
            best=frozenset(best),
        )  # fmt: skip

    def gaps(self) -> list[TextTable]:
        """Return a table of shares of the gap for each condition with all_hr and another ablation.

        It has the share of each ablation and score in percent, scene by scene and in the mean over
        scenes. Notes say why a scene has no share, or why pairs are left out of a mean.
        """
        means, per_scene = by_key(self.comparison.gaps), by_key(self.comparison.gaps_per_scene)
        conditions = dict.fromkeys(condition for _, condition, _ in means)
        return [self._gap(condition, means, per_scene) for condition in conditions]

    def _gap(
        self,
        condition: str,
        means: dict[tuple[str, ...], Change],
        per_scene: dict[tuple[str, ...], Change],
    ) -> TextTable:
        comparison, base, scenes = self.comparison, self.comparison.base, self.comparison.scenes
        labels = [name for name, of in comparison.groups if of == condition and name != ALL_HR]
        rows: list[tuple[str, ...]] = []
        left_out: dict[str, list[str]] = {}  # note -> its ablations
        for label in labels:
            for metric in comparison.metrics:
                mean = means.get((label, condition, metric.name))
                if mean is None:
                    continue
                changes = [per_scene.get((label, condition, s, metric.name)) for s in scenes]
                shares = [MISSING if row is None else signed(row.change) for row in changes]
                shares.append(f"{signed(mean.change)}{lacking(mean, len(scenes))}")
                bounds = interval(mean.low, mean.high)
                rows.append((label, metric.label, *shares, bounds, same_sign(mean)))
                for scene, row in zip(scenes, changes, strict=True):
                    if row is not None and row.why:
                        what = "n/a" if math.isnan(row.change) else "pairs left out"
                        note = f"{metric.label}, {scene}: {what} ({row.why})"
                        left_out.setdefault(note, []).append(label)
        table = TextTable(
            title=titled(f"Share of the gap from {base} to {ALL_HR} that is closed, %", condition),
            columns=("Ablation", "Metric", *scenes, "mean", "95 % interval", "same sign (p)"),
            rows=tuple(rows),
            align="ll" + "r" * (len(scenes) + 3),
            notes=(
                *self._context(condition).cautions,
                f"100 (ablation - {base}) / ({ALL_HR} - {base}): 0 is {base}, 100 is {ALL_HR},"
                " which trains on the originals of the degraded photographs",
                *(
                    note if len(of) == len(labels) else f"{note}: {', '.join(of)}"
                    for note, of in left_out.items()
                ),
            ),
            context=self._context(condition).of_scores,
        )
        return filled(table)

    def missing(self) -> TextTable | None:
        """Return a table of the cells without results, with the reasons; None if all have some.

        A long reason, such as COLMAP's for a scene without cameras, is a note below the table.
        """
        rows = self.comparison.missing()
        if rows.empty:
            return None
        long = [text for text in rows["reason"].unique() if len(text) > _MAX_REASON]
        marks = {text: f"see ({number})" for number, text in enumerate(long, 1)}
        rows = rows.assign(reason=rows["reason"].replace(marks))
        keys = ["scene", "label", "condition", "variant_seed", "seed", "state", "reason"]
        return TextTable(
            title=f"{len(rows)} of {len(self.comparison.cells)} cells gave no number",
            columns=("Scene", "Label", "Condition", "variant.seed", "seed", "State", "Reason"),
            rows=tuple(tuple(map(str, row)) for row in rows[keys].itertuples(index=False)),
            align="lllrrll",
            notes=tuple(f"({number}) {text}" for number, text in enumerate(long, 1)),
        )

    def long(self) -> pd.DataFrame:
        """Return all changes at full precision, one in each row: the content of `table.csv`."""
        metrics = {metric.name: metric for metric in self.comparison.metrics}
        scenes = self.comparison.per_scene.reset_index()
        means = self.comparison.means.reset_index()
        scenes = scenes.assign(level="scene", outcome=False)  # verdicts are of means
        table = pd.concat([means.assign(level="mean", scene=""), scenes])
        gaps = [
            self.comparison.gaps.reset_index().assign(level="mean", scene=""),
            self.comparison.gaps_per_scene.reset_index().assign(level="scene"),
        ]
        shares = pd.concat(gaps)[[*_LEVEL, *_GAP]].rename(columns=_GAP)
        table = table.merge(shares, how="left", on=_LEVEL)
        rows = [*by_key(table).values()]
        of = [metrics[name] for name in table["metric"]]
        table["printed"] = [pointed(r.change, m).rstrip() for r, m in zip(rows, of, strict=True)]
        table["verdict"] = [verdict(r, m) for r, m in zip(rows, of, strict=True)]
        table["agree"] = [row.agree for row in rows]
        table["metric_unit"] = [m.unit for m in of]
        table["change_unit"] = [*map(change_unit, of)]
        table["against"] = self.comparison.base
        table["higher_is_better"] = [m.higher_is_better for m in of]
        table = table.rename(columns={"n": "n_values", "unit": "n_of", "holm": "p_holm"})
        return table[
            [*_LEVEL, "metric_unit", "higher_is_better", "outcome", "against", "base", "value",
             "change", "change_unit", "low", "high", "new_low", "new_high",
             "n_values", "n_of", "scenes", "pairs", "agree", "p_sign",
             "scatter_replicates", "scatter_scenes", "p", "q", "p_holm", "p_equivalent",
             "printed", "verdict", "why", *_GAP.values()]
        ]  # fmt: skip


def _score(value: float, metric: Metric) -> str:
    """Write a score as papers do: dB with two decimals, the others with three."""
    return "n/a" if math.isnan(value) else f"{value:.{2 if metric.unit == 'dB' else 3}f}"


def _best(values: list[float], metric: Metric) -> list[int]:
    """Return the indices of the best values as printed; none if all are printed alike."""
    by_text = {_score(v, metric): v for v in values if not math.isnan(v)}
    if len(by_text) < 2:
        return []
    best = (max if metric.higher_is_better else min)(by_text, key=lambda text: by_text[text])
    return [row for row, value in enumerate(values) if _score(value, metric) == best]


def _mean_row(row: Change, metric: Metric, scenes: int, shared: str) -> tuple[str, ...]:
    """Return the row of a change in the table of its ablation."""
    own_verdict = verdict(row, metric)
    return (
        metric.label,
        number(row.base, metric.unit),
        number(row.value, metric.unit),
        f"{with_unit(row.change, metric)}{lacking(row, scenes)}",
        interval(row.low, row.high),
        interval(row.new_low, row.new_high),
        same_sign(row),
        p_value(row.p_corrected),
        "" if own_verdict == shared else own_verdict,
    )


def _listed(replicates: set[tuple[int, int]]) -> str:
    """List the replicates (variant.seed, seed) of a mean, or count them if there are many.

    If all have the same `variant.seed`, only `seed` is listed.
    """
    if len(replicates) > _MAX_LISTED:
        return f"{len(replicates)} replicates"
    several = "s" * (len(replicates) > 1)
    if len({draw for draw, _ in replicates}) == 1:
        return f"seed{several} " + ", ".join(str(seed) for _, seed in sorted(replicates))
    texts = (f"{draw}/{seed}" for draw, seed in sorted(replicates))
    return f"replicate{several} {', '.join(texts)} (variant.seed/seed)"
