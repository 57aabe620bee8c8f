"""Writes numbers, changes and intervals for tables, and the table that explains them."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from typing import NamedTuple

import pandas as pd

from xrgs.evaluation.metrics import Metric
from xrgs.report.compare import Comparison, is_ratio
from xrgs.report.inference import LEVEL, MIN_VALUES
from xrgs.runtime.text import TextTable

#: Arrows mean improvement and degradation, as in the paper's tables: fewer Gaussians are `↑`.
BETTER, WORSE, SAME = "↑", "↓", "="
#: The text in place of a number if no cell behind it is done.
MISSING = "missing"
#: The verdict of a change without an interval.
NO_INTERVAL = "one replicate: no interval"
#: Verdict -> its mark after a change.
_MARKS = {"better": " *", "worse": " *", "equivalent": " ≈"}
#: Counts of at least this size are written with one of these prefixes, as 17.9 G.
_LARGE, _PREFIXES = 1e7, ((1e12, "T"), (1e9, "G"), (1e6, "M"))


class Change(NamedTuple):
    """One row of `Comparison.means` or `Comparison.per_scene`: each field is a column."""

    base: float
    value: float
    change: float
    low: float
    high: float
    new_low: float
    new_high: float
    n: int
    unit: str
    scenes: int
    pairs: int
    up: int
    down: int
    scatter_replicates: float
    scatter_scenes: float
    p: float
    p_sign: float
    why: str
    outcome: bool = False
    q: float = math.nan
    holm: float = math.nan
    p_equivalent: float = math.nan

    @property
    def agree(self) -> int:
        """How many of the n values have the sign of their mean."""
        if self.change > 0:
            return self.up
        return self.down if self.change < 0 else self.n - self.up - self.down

    @property
    def p_corrected(self) -> float:
        """Holm's p of a headline label, else q."""
        return self.q if math.isnan(self.holm) else self.holm


def number(value: float, unit: str) -> str:
    """Write a value with its unit, at a precision that fits its size; NaN as n/a.

    Bytes are written in MiB; counts of ten million or more with three digits and an SI prefix:
    `17.9 G`.
    """
    if math.isnan(value):
        return "n/a"
    if unit == "bytes":
        return f"{value / 2**20:,.1f} MiB"
    if not unit and _LARGE <= abs(value) < math.inf:
        scale, prefix = next(p for p in _PREFIXES if abs(value) >= 0.9995 * p[0])
        return f"{value / scale:#.3g} {prefix}".replace(". ", " ")
    if math.isinf(value) or abs(value) >= {"s": 10, "": 100}.get(unit, 1000):
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
    """Return `BETTER`, `WORSE`, `SAME` for a change that is printed as 0.00, or a space for NaN."""
    if math.isnan(change):
        return " "
    if signed(change) == "0.00":
        return SAME
    return BETTER if (change > 0) == metric.higher_is_better else WORSE


def named(metric: Metric) -> str:
    """Return the name of a metric with the unit of its changes: `PSNR, dB` or `LPIPS, %`."""
    return f"{metric.label}, {change_unit(metric)}"


def change_unit(metric: Metric) -> str:
    """Return the unit of a metric's changes."""
    return "%" if is_ratio(metric) else metric.unit


def pointed(change: float, metric: Metric) -> str:
    """Write a change with its arrow as the paper's tables do: `-44.57 ↑`."""
    return f"{signed(change)} {arrow(change, metric)}"


def with_unit(change: float, metric: Metric) -> str:
    """Write a change with its unit and arrow: `-44.57 % ↑`."""
    unit = "" if math.isnan(change) else f" {change_unit(metric)}"
    return f"{signed(change)}{unit} {arrow(change, metric)}"


def verdict(row: Change, metric: Metric) -> str:
    """Return the verdict of a change's tests, in words.

    It is `equivalent` if the change is within its margin (TOST), else `better` or `worse` if the
    corrected p is at most 0.05, else `not shown`. It is `descriptive` for a metric that is no
    outcome, `one replicate: no interval`, or `n/a` with the reason.
    """
    if math.isnan(row.change):
        return f"n/a: {row.why}"
    if math.isnan(row.low):
        return NO_INTERVAL
    if not row.outcome:
        return "descriptive"
    if row.p_equivalent <= LEVEL:
        return "equivalent"
    if row.p_corrected <= LEVEL:
        return "better" if (row.change > 0) == metric.higher_is_better else "worse"
    return "not shown"


def marked(row: Change | None, metric: Metric, scenes: int) -> str:
    """Write a mean over `scenes` scenes with its marks: `-44.57 ↑ * (3 of 4)`.

    `*` says that it is shown to be better or worse, `≈` that it is equivalent, and the number of
    scenes that some are lacking.
    """
    if row is None:
        return MISSING
    mark = _MARKS.get(verdict(row, metric), "")
    return f"{pointed(row.change, metric)}{mark}{lacking(row, scenes)}"


def lacking(row: Change, scenes: int) -> str:
    """Write how many scenes a mean includes, ` (3 of 4)`; empty if all or none."""
    return f" ({row.scenes} of {scenes})" if 0 < row.scenes < scenes else ""


def p_value(p: float) -> str:
    """Write a p or q with three decimals; empty for NaN."""
    if math.isnan(p):
        return ""
    return "<0.001" if p < 0.001 else f"{p:.3f}"


def interval(low: float, high: float) -> str:
    """Write an interval, `-1.20 to +3.40`; empty for NaN."""
    return "" if math.isnan(low) else f"{signed(low)} to {signed(high)}"


def same_sign(row: Change) -> str:
    """Write how many values have the sign of their mean, and the p of the sign test.

    It is `4 of 4 (0.125)`, and empty for fewer than two values.
    """
    return f"{row.agree} of {row.n} ({p_value(row.p_sign)})" if row.n > 1 else ""


def legend(comparison: Comparison, tables: Sequence[TextTable]) -> TextTable:
    """Return the table that explains the columns and marks that occur in tables of changes."""
    design, base = comparison.design, comparison.base
    outcomes = ", ".join(m.label for m in comparison.metrics if m.name in design.outcomes)
    # Term, the head of its column, the pattern of its mark in a cell's text, meaning.
    rows = (
        ("change", "", rf" [{BETTER}{WORSE}{SAME}]",
         f"mean over scenes of the means over replicates: the difference from {base} in dB, or the"
         f" mean log(value / {base}) in percent"),
        (f"{BETTER} {WORSE} {SAME}", "", rf" [{BETTER}{WORSE}{SAME}]",
         "improvement, degradation, no change at this precision"),
        ("(3 of 4)", "", r"\(\d+ of \d+\)$", "beside a mean: it is over 3 of the 4 scenes"),
        ("95 % interval", "95 % interval", "",
         "Student's t over the scenes' means; of one scene, over its replicates"),
        ("new scene", "new scene", "",
         "95 % prediction interval of one more scene like these: of the mean over its replicates"),
        ("same sign (p)", "same sign (p)", "",
         "scenes that change as their mean does, and the p of the exact sign test; of one scene,"
         " replicates"),
        ("q", "q", r" \*( |$)",
         "Benjamini and Hochberg's rate of false discoveries, from the t-tests of the outcomes of"
         f" all ablations of a condition, of at least {MIN_VALUES} values; amounts are corrected"
         " apart from scores"),
        ("p (Holm)", "p (Holm)", "",
         f"the p of {', '.join(design.headline)}, corrected by Holm instead of q"),
        ("better, worse *", "", r"^(better|worse)$| \*( |$)",
         f"q, or the p of Holm, is at most {LEVEL:g}"),
        ("equivalent ≈", "", r"^equivalent$| ≈( |$)",
         f"the change is within {design.margin_psnr:g} dB of PSNR or {design.margin_lpips:g} % of"
         f" LPIPS: p of two one-sided t-tests (TOST) is at most {LEVEL:g}"),
        ("not shown", "", "^not shown$", "neither better, nor worse, nor equivalent by its tests"),
        ("descriptive", "", "^descriptive$",
         f"without a verdict: the outcomes of this report are {outcomes}"),
    )  # fmt: skip
    heads = {head for table in tables for head in table.columns}
    texts = {text for table in tables for row in table.rows for text in row}
    shown = tuple(
        (term, meaning)
        for term, head, mark, meaning in rows
        if head in heads or (mark and any(re.search(mark, text) for text in texts))
    )
    return TextTable("How to read the tables", ("", "meaning"), shown, "ll", prose=True)


def by_key(table: pd.DataFrame) -> dict[tuple[str, ...], Change]:
    """Convert one of a `Comparison`'s tables of means: index of a row -> the row."""
    columns = [name for name in Change._fields if name in table]
    rows = table[columns].itertuples(index=False)
    return {
        key: Change(**dict(zip(columns, row, strict=True)))
        for key, row in zip(table.index, rows, strict=True)
    }
