"""Builds the tables of how much of the gap between the baseline and all_hr each ablation closes."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from xrgs.report.compare import ALL_HR
from xrgs.report.render import TextTable, titled
from xrgs.report.tables import (
    AGREEMENT_NOTE,
    agreement,
    by_key,
    interval,
    interval_note,
    signed,
)

if TYPE_CHECKING:
    from xrgs.report.compare import Comparison
    from xrgs.report.tables import Change

_NOTE = (
    "100 (ablation - baseline) / (all_hr - baseline): 0 is the baseline, 100 is all_hr, which"
    " trains on the originals of the degraded photographs"
)


def gap_tables(comparison: Comparison) -> list[TextTable]:
    """Return a table for each condition that has all_hr and another ablation.

    Args:
        comparison: The pairs of cells, and the means of the shares that they close.

    Returns:
        Tables with a row for each ablation and score: the share in percent, scene by scene and in
        the mean over scenes, with Student's interval and how many pairs agree. Notes say why a
        scene has no share, or a mean leaves out some of its pairs.
    """
    means, per_scene = by_key(comparison.gaps), by_key(comparison.gaps_per_scene)
    conditions = dict.fromkeys(condition for _, condition, _ in means)
    return [_table(comparison, condition, means, per_scene) for condition in conditions]


def _table(
    comparison: Comparison,
    condition: str,
    means: dict[tuple[str, ...], Change],
    per_scene: dict[tuple[str, ...], Change],
) -> TextTable:
    scenes = comparison.scenes
    labels = [name for name, of in comparison.groups if of == condition and name != ALL_HR]
    rows: list[tuple[str, ...]] = []
    left_out: dict[str, list[str]] = {}
    for label in labels:
        for metric in comparison.metrics:
            mean = means.get((label, condition, metric.name))
            if mean is None:
                continue
            found = [per_scene.get((label, condition, s, metric.name)) for s in scenes]
            shares = ["failed" if row is None else signed(row.change) for row in (*found, mean)]
            rows.append((label, metric.label, *shares, interval(mean), agreement(mean)))
            for scene, row in zip(scenes, found, strict=True):
                if row is not None and row.why:
                    what = "n/a" if math.isnan(row.change) else "pairs left out"
                    note = f"{metric.label}, {scene}: {what} ({row.why})"
                    left_out.setdefault(note, []).append(label)
    notes = (
        note if len(of) == len(labels) else f"{note}: {', '.join(of)}"
        for note, of in left_out.items()
    )
    here = [row for key, row in means.items() if key[1] == condition]
    over = interval_note(here, one_each=_one_replicate(comparison, condition))
    return TextTable(
        title=titled(f"Share of the gap from baseline to {ALL_HR} that is closed, %", condition),
        columns=("Ablation", "Metric", *scenes, "mean", "95 % interval, %", "pairs that agree"),
        rows=tuple(rows),
        align="ll" + "r" * (len(scenes) + 3),
        notes=(_NOTE, *notes, AGREEMENT_NOTE, *over),
    )


def _one_replicate(comparison: Comparison, condition: str) -> bool:
    """Return whether each ablation has one pair in each scene."""
    here = comparison.pairs[comparison.pairs["condition"] == condition]
    return set(here.groupby(["label", "scene"])["cell_id"].nunique()) == {1}
