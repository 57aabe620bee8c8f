"""The statistics of a report: changes of pairs, Student's intervals and tests, false discoveries.

All functions take and return float64 arrays [N], one element for each pair or mean. A number that
can't be computed is NaN, and a reason says why.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy.special import stdtr, stdtrit
from scipy.stats import false_discovery_control

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]

CONFIDENCE = 0.95
#: The fewest values behind a mean that a verdict or a test may rest on: our choice. Two values show
#: too little of their scatter: Student's interval of them is 13 times as wide as they are apart.
MIN_VALUES = 3
#: The rate of false discoveries up to which a change is marked: our choice, as usual.
FALSE_DISCOVERIES = 0.05
NOT_MEASURED = "not measured"
OTHER_MACHINE = "timed on another machine"
OTHER_CODE = "scored by other code"
ZERO_BASE = "compared with zero"
NOT_FINITE = "not finite"
NOT_POSITIVE = "not above zero"

#: Label of the cells that the share of the gap is measured by.
ALL_HR = "all_hr"
NO_ALL_HR = f"{ALL_HR} gave no number to compare"
NO_GAP = f"{ALL_HR} has the same value"
WRONG_GAP = f"{ALL_HR} is worse"


def percent_change(base: Floats, value: Floats) -> tuple[Floats, NDArray[np.str_]]:
    """Return the change 100 (value - base) / |base|.

    The magnitude is taken so that a larger value is a positive change below zero as well: SSIM and
    PSNR can be negative.

    Args:
        base: [N] values of the base.
        value: [N] values of the ablation, in the same unit.

    Returns:
        The changes in percent [N], and why there is none [N], empty where there is one.

    Examples:
        >>> percent_change(np.array([20.0, 0.0]), np.array([25.0, 1.0]))[0]
        array([25., nan])
    """
    with np.errstate(all="ignore"):
        change = 100 * (value - base) / np.abs(base)
    change = np.where((base == 0) & (value == 0), 0.0, change)
    why = np.select(
        [
            np.isnan(base) | np.isnan(value),
            np.isfinite(value) & (base == 0) & (value != 0),
            ~np.isfinite(change),
        ],
        [NOT_MEASURED, ZERO_BASE, NOT_FINITE],
        default="",
    )
    return np.where(why == "", change, np.nan), why


def log_ratio(base: Floats, value: Floats) -> tuple[Floats, NDArray[np.str_]]:
    """Return log(value / base), the change of an amount that is above zero.

    Halving and doubling are then changes of the same size with a mean of 0, and an interval never
    reaches below -100 %.

    Args:
        base: [N] amounts of the base.
        value: [N] amounts of the ablation, in the same unit.

    Returns:
        The logarithms [N], and why there is none [N], empty where there is one. Equal amounts have
        0, also where both are zero.

    Examples:
        >>> log_ratio(np.array([2.0, 2.0]), np.array([2.0, 0.0]))[0]
        array([ 0., nan])
    """
    _, why = percent_change(base, value)
    positive = (base > 0) & (value > 0)
    why = np.where((why == "") & ~positive & (base != value), NOT_POSITIVE, why)
    with np.errstate(all="ignore"):
        ratio = np.where(base == value, 0.0, np.log(value / base))
    why = np.where((why == "") & ~np.isfinite(ratio), NOT_FINITE, why)
    return np.where(why == "", ratio, np.nan), why


def share_of_gap(
    base: Floats, value: Floats, all_hr: Floats, *, higher_is_better: bool
) -> tuple[Floats, NDArray[np.str_]]:
    """Return the share of the gap between the base and all_hr that is closed, in percent.

    Args:
        base: [N] values of the base.
        value: [N] values of the ablation, in the same unit.
        all_hr: [N] values of all_hr, in the same unit; NaN where it gave none.
        higher_is_better: The direction of the metric.

    Returns:
        The shares [N], and why there is none [N], empty where there is one. A share is negative
        where the ablation is worse than the base, and above 100 where it is better than all_hr.

    Examples:
        >>> args = np.array([20.0]), np.array([23.0]), np.array([24.0])
        >>> share_of_gap(*args, higher_is_better=True)[0]
        array([75.])
    """
    with np.errstate(all="ignore"):
        gap = all_hr - base
        share = 100 * (value - base) / gap
    why = np.select(
        [
            np.isnan(base) | np.isnan(value),
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


def p_values(mean: Floats, spread: Floats, n: Floats) -> Floats:
    """Return the p of Student's two-sided test, of each mean, that the true mean is 0.

    It is below 0.05 just where the 95 % interval does not hold 0.

    Args:
        mean: [N] means.
        spread: [N] sample standard deviations, with n - 1 in the denominator, in the same unit.
        n: [N] number of values behind each mean.

    Returns:
        [N]; 1 where all values are 0, and NaN for fewer than `MIN_VALUES`.
    """
    with np.errstate(all="ignore"):
        p = 2 * stdtr(n - 1, -np.abs(mean) / spread * np.sqrt(n))
    return np.where(n >= MIN_VALUES, np.where(mean == 0, 1.0, p), np.nan)


def false_discovery_rates(p: Floats) -> Floats:
    """Return q of each test: the least rate of false discoveries at which it is one.

    Of the m tests sorted by p, q of the i-th is the minimum of p_j m / j over j >= i. It holds for
    tests that are independent or positively dependent.

    Source: [benjamini1995].

    Args:
        p: [N] values of p; NaN where there is no test, which does not count among the m.

    Returns:
        [N], NaN where p is.

    Examples:
        >>> false_discovery_rates(np.array([0.02, 0.9, np.nan, 0.01]))
        array([0.03, 0.9 ,  nan, 0.03])
    """
    q = np.full_like(p, np.nan)
    tested = ~np.isnan(p)
    if tested.any():
        q[tested] = false_discovery_control(p[tested])
    return q
