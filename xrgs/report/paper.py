"""The paper's Tables 1 and 2 beside a comparison's own changes, sign by sign [xrgs, section 7]."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

from xrgs.experiment.store import BASELINE
from xrgs.report.context import context_of
from xrgs.report.inference import MIN_VALUES
from xrgs.report.render import TextTable, filled, titled
from xrgs.report.writing import (
    ARROWS_NOTE,
    agreement,
    agreement_note,
    by_key,
    interval,
    lacking,
    percent,
)
from xrgs.safeio.sanitize import counted

if TYPE_CHECKING:
    from collections.abc import Mapping

    from xrgs.evaluation.metrics import Metric
    from xrgs.report.compare import Comparison
    from xrgs.report.context import Context
    from xrgs.report.writing import Change

#: Labels of the full XR-GS, with one reading of section 5.4 each.
_READINGS = ("xrgs", "xrgs_per_class", "xrgs_own_threshold")
#: The scenes of LLFF that Table 1 is the mean of.
_LLFF = frozenset({"fern", "flower", "fortress", "horns", "orchids", "room", "trex"})


class _Column(NamedTuple):
    """A column of one of the paper's tables: changes in percent by the metric's name."""

    title: str
    scenes: frozenset[str]
    """The scene that it is of, and the one that takes its place here; those of Table 1."""
    changes: Mapping[str, float]


_TABLE_1 = _Column(
    "the paper's Table 1",
    _LLFF,
    {
        "training_time_s": -44.57,
        "gaussians": -69.68,
        "memory_bytes": -46.50,
        "lpips": 23.15,
        "ssim": 0.45,
        "psnr": -0.80,
    },
)
_TABLE_2 = (
    _Column(
        "the paper's Table 2, Dining Room",
        frozenset({"dining_room", "reichstag"}),
        {
            "training_time_s": -24.87,
            "gaussians": -70.99,
            "memory_bytes": -33.08,
            "lpips": -8.83,
            "ssim": 3.60,
            "psnr": 3.92,
        },
    ),
    _Column(
        "the paper's Table 2, Keychain",
        frozenset({"keychain", "ollie"}),
        {
            "training_time_s": -16.32,
            "gaussians": -66.05,
            "memory_bytes": -2.59,
            "lpips": 33.23,
            "ssim": -1.56,
            "psnr": -15.81,
        },
    ),
)


def paper_tables(comparison: Comparison, contexts: Mapping[str, Context]) -> list[TextTable]:
    """Return the paper's tables beside the changes of full XR-GS from the baseline.

    Args:
        comparison: The pairs of cells.
        contexts: How the cells of each condition were trained and scored.

    Returns:
        A table for each condition and column of the paper of which the comparison has scenes: none
        where nothing is full XR-GS, or the changes are from another label than the baseline.
    """
    if comparison.base != BASELINE:
        return []
    means, per_scene = by_key(comparison.means), by_key(comparison.per_scene)
    tables = []
    for condition in dict.fromkeys(condition for _, condition in comparison.groups):
        context = context_of(contexts, condition).of_all
        if _LLFF.issuperset(comparison.scenes):
            tables.append(_table(comparison, condition, _TABLE_1, means, "", context))
        for column in _TABLE_2:
            for scene in sorted(column.scenes.intersection(comparison.scenes)):
                here: dict[tuple[str, ...], Change] = {
                    (label, of, metric): row
                    for (label, of, name, metric), row in per_scene.items()
                    if name == scene
                }
                tables.append(_table(comparison, condition, column, here, scene, context))
    return [table for table in tables if table.rows]


def _table(
    comparison: Comparison,
    condition: str,
    column: _Column,
    changes: Mapping[tuple[str, ...], Change],
    scene: str,
    context: str,
) -> TextTable:
    """Return a column of the paper beside changes of one scene, or means over scenes."""
    scenes = 1 if scene else len(comparison.scenes)
    rows = [
        _row(label, metric, column.changes[metric.name], found, scenes)
        for label in _READINGS
        for metric in comparison.metrics
        if metric.name in column.changes
        and (found := changes.get((label, condition, metric.name))) is not None
    ]
    of = scene or f"mean over {counted(scenes, 'scene')}"
    table = TextTable(
        title=titled(f"Beside {column.title}: {of}", condition),
        columns=(
            *("XR-GS", "Metric", "paper, %", f"change from {BASELINE}, %", "95 % interval, %"),
            *("pairs that agree", "the paper's sign is"),
        ),
        rows=tuple(rows),
        align="llrrrrl",
        notes=(
            "confirmed: the interval is on the paper's side of 0; refuted: it is on the other side;"
            " open: it holds 0, or there is none",
            ARROWS_NOTE,
            *agreement_note(changes.values()),
        ),
        context=context,
    )
    return filled(table)


def _row(label: str, metric: Metric, paper: float, found: Change, scenes: int) -> tuple[str, ...]:
    return (
        label,
        metric.label,
        percent(paper, metric),
        f"{percent(found.change, metric)}{lacking(found, scenes)}",
        interval(found),
        agreement(found),
        _verdict(found, paper),
    )


def _verdict(found: Change, paper: float) -> str:
    """Say whether a change has the sign that the paper gives.

    Args:
        found: The change with its interval.
        paper: The paper's change in percent, which is not 0.

    Returns:
        `confirmed`, `refuted`, or `open`; the latter too where fewer than three values are behind
        the interval.
    """
    if math.isnan(found.low) or found.n < MIN_VALUES or found.low <= 0 <= found.high:
        return "open"
    return "confirmed" if (found.change > 0) == (paper > 0) else "refuted"
