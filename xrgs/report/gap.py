"""Builds the tables of how much of the gap between the base and all_hr each ablation closes."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from xrgs.report.context import context_of
from xrgs.report.inference import ALL_HR
from xrgs.report.render import filled, titled
from xrgs.report.writing import (
    LACKING_NOTE,
    MISSING,
    agreement,
    agreement_note,
    by_key,
    interval,
    interval_note,
    lacking,
    signed,
)
from xrgs.runtime.text import TextTable

if TYPE_CHECKING:
    from collections.abc import Mapping

    from xrgs.report.compare import Comparison
    from xrgs.report.context import Context
    from xrgs.report.writing import Change


def gap_tables(comparison: Comparison, contexts: Mapping[str, Context]) -> list[TextTable]:
    """Return a table for each condition that has all_hr and another ablation.

    Args:
        comparison: The pairs of cells, and the means of the shares that they close.
        contexts: How the cells of each condition were trained and scored.

    Returns:
        Tables with a row for each ablation and score: the share in percent, scene by scene and in
        the mean over scenes, with Student's interval and how many pairs agree. Notes say why a
        scene has no share, or a mean leaves out some of its pairs.
    """
    means, per_scene = by_key(comparison.gaps), by_key(comparison.gaps_per_scene)
    conditions = dict.fromkeys(condition for _, condition, _ in means)
    return [_table(comparison, contexts, condition, means, per_scene) for condition in conditions]


def _table(
    comparison: Comparison,
    contexts: Mapping[str, Context],
    condition: str,
    means: dict[tuple[str, ...], Change],
    per_scene: dict[tuple[str, ...], Change],
) -> TextTable:
    base, scenes = comparison.base, comparison.scenes
    labels = [name for name, of in comparison.groups if of == condition and name != ALL_HR]
    rows: list[tuple[str, ...]] = []
    for label in labels:
        for metric in comparison.metrics:
            mean = means.get((label, condition, metric.name))
            if mean is None:
                continue
            found = [per_scene.get((label, condition, s, metric.name)) for s in scenes]
            shares = [MISSING if row is None else signed(row.change) for row in found]
            shares.append(f"{signed(mean.change)}{lacking(mean, len(scenes))}")
            rows.append((label, metric.label, *shares, interval(mean), agreement(mean)))
    here = [row for key, row in means.items() if key[1] == condition]
    what = (
        f"100 (ablation - {base}) / ({ALL_HR} - {base}): 0 is {base}, 100 is {ALL_HR}, which trains"
        " on the originals of the degraded photographs"
    )
    notes = (
        *(what, *_left_out(comparison, condition, labels, per_scene), *agreement_note(here)),
        *interval_note(here, one_each=_one_replicate(comparison, condition)),
        *[LACKING_NOTE] * any(lacking(row, len(scenes)) for row in here),
    )
    table = TextTable(
        title=titled(f"Share of the gap from {base} to {ALL_HR} that is closed, %", condition),
        columns=("Ablation", "Metric", *scenes, "mean", "95 % interval, %", "pairs that agree"),
        rows=tuple(rows),
        align="ll" + "r" * (len(scenes) + 3),
        notes=notes,
        context=context_of(contexts, condition).of_scores,
    )
    return filled(table)


def _left_out(
    comparison: Comparison,
    condition: str,
    labels: list[str],
    per_scene: dict[tuple[str, ...], Change],
) -> list[str]:
    """Say why scenes have no share, or one of fewer pairs; once for ablations that share it."""
    left_out: dict[str, list[str]] = {}
    for label in labels:
        for metric in comparison.metrics:
            for scene in comparison.scenes:
                row = per_scene.get((label, condition, scene, metric.name))
                if row is not None and row.why:
                    what = "n/a" if math.isnan(row.change) else "pairs left out"
                    note = f"{metric.label}, {scene}: {what} ({row.why})"
                    left_out.setdefault(note, []).append(label)
    return [
        note if len(of) == len(labels) else f"{note}: {', '.join(of)}"
        for note, of in left_out.items()
    ]


def _one_replicate(comparison: Comparison, condition: str) -> bool:
    """Return whether each ablation has one pair in each scene."""
    here = comparison.pairs[comparison.pairs["condition"] == condition]
    return set(here.groupby(["label", "scene"])["cell_id"].nunique()) == {1}
