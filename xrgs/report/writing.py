"""Writes numbers, changes and intervals as tables show them, and the notes that explain them."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

from xrgs.report.compare import is_amount
from xrgs.report.inference import FALSE_DISCOVERIES, MIN_VALUES

if TYPE_CHECKING:
    from collections.abc import Iterable

    import pandas as pd

    from xrgs.evaluation.metrics import Metric
    from xrgs.report.compare import Comparison

#: An arrow means improvement or degradation, as in the paper's tables, not larger or smaller.
BETTER, WORSE, SAME = "↑", "↓", "="
#: The text of a number whose cells all failed, or were not trained yet.
MISSING = "missing"
#: The reading of a change without an interval.
NO_INTERVAL = "one replicate: no interval"
ARROWS_NOTE = f"{BETTER} improvement, {WORSE} degradation, {SAME} no change at this precision"
LACKING_NOTE = "(k of n): a mean over k of the n scenes"
_MARK = "*"
#: Counts from this on are written in units of 10^6 or 10^9, as 17.9 G.
_LARGE = 1e7


class Change(NamedTuple):
    """One row of `Comparison.means` or `Comparison.per_scene`: each field is a column."""

    base: float
    value: float
    change: float
    difference: float
    low: float
    high: float
    n: int
    unit: str
    scenes: int
    scatter_replicates: float
    scatter_scenes: float
    p: float
    q: float
    why: str
    agree: int
    pairs: int


def number(value: float, unit: str) -> str:
    """Write a value with its unit, at a precision that fits its size; NaN as n/a.

    Bytes are written in MiB, and counts from ten million on with three digits in units of 10^6 or
    10^9: `17.9 G`.
    """
    if math.isnan(value):
        return "n/a"
    if unit == "bytes":
        return f"{value / 2**20:,.1f} MiB"
    if not unit and _LARGE <= abs(value) < math.inf:
        scale, prefix = (1e9, "G") if abs(value) >= 999.5e6 else (1e6, "M")
        return f"{value / scale:#.3g} {prefix}".replace(". ", " ")
    if math.isinf(value) or abs(value) >= (10 if unit == "s" else 1000):
        text = f"{value:,.0f}"
    elif unit:
        text = f"{value:.2f}"
    else:
        text = f"{value:.4f}" if value % 1 else f"{value:.0f}"
    return f"{text} {unit}".rstrip()


def signed(value: float) -> str:
    """Write a number with two decimals and a sign, zero without sign, NaN as n/a."""
    if math.isnan(value):
        return "n/a"
    text = f"{value:+,.2f}"
    return "0.00" if text in {"+0.00", "-0.00"} else text


def arrow(change: float, metric: Metric) -> str:
    """Return whether a change in percent is an improvement, in the metric's own direction.

    Returns:
        `BETTER`, `WORSE`, `SAME` where the change is printed as 0.00, or a space for NaN.
    """
    if math.isnan(change):
        return " "
    if signed(change) == "0.00":
        return SAME
    return BETTER if (change > 0) == metric.higher_is_better else WORSE


def percent(change: float, metric: Metric) -> str:
    """Write a change in percent as the paper's tables do: `-44.57 ↑`."""
    return f"{signed(change)} {arrow(change, metric)}"


def reading(row: Change, metric: Metric) -> str:
    """Say in words what the interval of a change shows.

    Returns:
        `better` or `worse` where the interval does not hold 0, `interval holds 0` where it does, or
        `unchanged`; `two values: no verdict`, `one replicate: no interval`, or `n/a` with the
        reason.
    """
    if math.isnan(row.change):
        return f"n/a: {row.why}"
    if math.isnan(row.low):
        return NO_INTERVAL
    if row.n < MIN_VALUES:
        return "two values: no verdict"
    if row.low <= 0 <= row.high and row.low < row.high:
        return "interval holds 0"
    if arrow(row.change, metric) == SAME:
        return "unchanged"
    return "better" if (row.change > 0) == metric.higher_is_better else "worse"


def marked(row: Change | None, metric: Metric, scenes: int) -> str:
    """Write a mean change with its marks: `-44.57 ↑ * (3 of 4)`.

    Args:
        row: The change; None where no pair of cells is done.
        metric: The metric that changed.
        scenes: How many scenes the mean should be over.

    Returns:
        The change, a star where q is at most 0.05, and the number of scenes behind the mean where
        some are lacking.
    """
    if row is None:
        return MISSING
    return f"{percent(row.change, metric)}{_star(row)}{lacking(row, scenes)}"


def lacking(row: Change, scenes: int) -> str:
    """Write how many scenes a mean is over, ` (3 of 4)`; empty where it is over all or none."""
    return f" ({row.scenes} of {scenes})" if 0 < row.scenes < scenes else ""


def false_discovery(row: Change) -> str:
    """Write q of a change, `0.034 *`, with a star where it is at most 0.05; empty for NaN."""
    if math.isnan(row.q):
        return ""
    return f"{'<0.001' if row.q < 0.001 else f'{row.q:.3f}'}{_star(row)}"


def _star(row: Change) -> str:
    return f" {_MARK}" if row.q <= FALSE_DISCOVERIES else ""


def scatter(deviation: float) -> str:
    """Write a standard deviation in percent; empty for NaN."""
    return "" if math.isnan(deviation) else f"{deviation:,.2f}"


def interval(row: Change) -> str:
    """Write the 95 % interval of a change in percent; empty where there is none."""
    return "" if math.isnan(row.low) else f"{signed(row.low)} to {signed(row.high)}"


def agreement(row: Change) -> str:
    """Write how many of several pairs changed in the direction of their mean, `11 of 12`."""
    return f"{row.agree} of {row.pairs}" if row.pairs > 1 else ""


def agreement_note(rows: Iterable[Change]) -> tuple[str, ...]:
    """Explain the column of pairs that agree; nothing where no row has several pairs."""
    if not any(map(agreement, rows)):
        return ()
    return ("pairs that agree: pairs of one scene and replicate that change as their mean does",)


def scatter_note(rows: Iterable[Change]) -> tuple[str, ...]:
    """Say what the standard deviations of a table are over; nothing where there are none."""
    if not any(scatter(row.scatter_replicates) or scatter(row.scatter_scenes) for row in rows):
        return ()
    return (
        "sd replicates: standard deviation of the replicates, pooled within scenes; sd scenes:"
        " standard deviation of the scenes' means",
    )


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


def scale_note(comparison: Comparison) -> str:
    """Say which metrics are compared by ratio and which by percentage."""
    amounts = ", ".join(metric.label for metric in comparison.metrics if is_amount(metric))
    scores = ", ".join(metric.label for metric in comparison.metrics if not is_amount(metric))
    return (
        f"means, intervals and sd: of log(value / {comparison.base}), turned into %, for {amounts};"
        f" of the change in % for {scores}"
    )


def false_discovery_note(comparison: Comparison, condition: str) -> tuple[str, ...]:
    """Say what q is and which tests of a condition it is over; nothing where there are none."""
    of = comparison.means.index.get_level_values("condition") == condition
    tests = comparison.means.loc[of, "p"].count()
    if not tests:
        return ()
    return (
        f"q: Benjamini and Hochberg's rate of false discoveries over {tests} t-tests, of all"
        f" ablations and metrics with at least {MIN_VALUES} values; {_MARK} where it is at most"
        f" {FALSE_DISCOVERIES:g}",
    )


def by_key(table: pd.DataFrame) -> dict[tuple[str, ...], Change]:
    """Return the rows of one of a `Comparison`'s tables of means, by their keys."""
    rows = table[list(Change._fields)].itertuples(index=False)
    return {key: Change(*row) for key, row in zip(table.index, rows, strict=True)}
