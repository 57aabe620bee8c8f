"""The statistics of a report: changes of pairs, intervals, tests, and corrections for many tests.

All functions take and return float64 arrays [N], one element for each pair or mean. `base` and
`value` are of the base and of the ablation, in the same unit. A mean is over `n` values, whose
sample standard deviation `spread`, in the same unit, has n - 1 in the denominator. A number that
can't be computed is NaN. Changes of pairs come with the reason why they can't be computed, else
empty.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.special import bdtr, stdtr, stdtrit

Floats = NDArray[np.float64]

CONFIDENCE = 0.95
#: The fewest values behind a mean with a verdict or a test; our choice. Two values show too little
#: of their scatter: Student's interval for them is 13 times as wide as their distance.
MIN_VALUES = 3
#: The largest (corrected) p at which a change, or an equivalence, counts as shown.
LEVEL = 0.05
NOT_MEASURED = "not measured"
OTHER_MACHINE = "timed on another machine"
OTHER_THREADS = "timed with another number of threads"
OTHER_CODE = "scored by other code"
NOT_FINITE = "not finite"
NOT_POSITIVE = "not above zero"

#: Label of the cells at the upper end of the gap, see `share_of_gap`.
ALL_HR = "all_hr"
NO_ALL_HR = f"{ALL_HR} gave no number to compare"
NO_GAP = f"{ALL_HR} has the same value"
WRONG_GAP = f"{ALL_HR} is worse"


def difference(base: Floats, value: Floats) -> tuple[Floats, NDArray[np.str_]]:
    """Return value - base, the change of a metric in dB."""
    with np.errstate(all="ignore"):
        change = value - base
    why = np.select(
        [np.isnan(base) | np.isnan(value), ~np.isfinite(change)],
        [NOT_MEASURED, NOT_FINITE],
        default="",
    )
    return np.where(why == "", change, np.nan), why


def log_ratio(base: Floats, value: Floats) -> tuple[Floats, NDArray[np.str_]]:
    """Return log(value / base), the change of a number that is above zero.

    Halving and doubling are then changes of the same size with a mean of 0, and an interval never
    reaches below -100 %. Equal finite values give 0, whatever their sign.

    Examples:
        >>> log_ratio(np.array([2.0, 2.0]), np.array([2.0, 0.0]))[0]
        array([ 0., nan])
    """
    with np.errstate(all="ignore"):
        ratio = np.where(base == value, 0.0, np.log(value / base))
    why = np.select(
        [
            np.isnan(base) | np.isnan(value),
            np.isinf(base) | np.isinf(value),
            (base != value) & ((base <= 0) | (value <= 0)),
            ~np.isfinite(ratio),
        ],
        [NOT_MEASURED, NOT_FINITE, NOT_POSITIVE, NOT_FINITE],
        default="",
    )
    return np.where(why == "", ratio, np.nan), why


def share_of_gap(
    base: Floats, value: Floats, all_hr: Floats, *, higher_is_better: bool
) -> tuple[Floats, NDArray[np.str_]]:
    """Return the share of the gap between the base and all_hr that is closed, %.

    `all_hr` is NaN if there is none. A share is negative if the ablation is worse than the base,
    and above 100 if it is better than all_hr.

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
    """Return half the width of Student's 95 % interval of each mean; NaN for one value."""
    with np.errstate(all="ignore"):
        return np.asarray(stdtrit(n - 1, 0.5 + CONFIDENCE / 2) * spread / np.sqrt(n))


def prediction_half_width(spread: Floats, n: Floats) -> Floats:
    """Return half the width of the 95 % interval for one more value, around the mean of n values.

    It is t s sqrt(1 + 1 / n), of n - 1 degrees of freedom, for values of a normal distribution; NaN
    for fewer than `MIN_VALUES`.
    """
    return np.where(n >= MIN_VALUES, half_width(spread, n) * np.sqrt(n + 1), np.nan)


def p_values(mean: Floats, spread: Floats, n: Floats) -> Floats:
    """Return the p of Student's two-sided test of each mean; null hypothesis: the true mean is 0.

    It is below 0.05 if and only if the 95 % interval does not contain 0. It is NaN for fewer than
    `MIN_VALUES`, or if all values are 0.
    """
    with np.errstate(all="ignore"):
        p = 2 * stdtr(n - 1, -np.abs(mean) / spread * np.sqrt(n))
    return np.where(n >= MIN_VALUES, p, np.nan)


def sign_test(up: Floats, down: Floats) -> Floats:
    """Return the p of the exact two-sided sign test; null hypothesis: the signs are equally likely.

    `up` and `down` count values above and below 0. Values of 0 are left out, as is usual. Without
    any value it is 1.
    """
    n = (up + down).astype(np.int64)
    return np.asarray(np.minimum(1.0, 2 * bdtr(np.minimum(up, down), n, 0.5)))


def equivalence(mean: Floats, spread: Floats, n: Floats, margin: Floats) -> Floats:
    """Return the p of two one-sided t-tests (TOST); null hypothesis: the mean is not in the margin.

    It is at most 0.05 if and only if the 90 % interval of the mean is within the margin, the
    largest change that does not matter. It is NaN for fewer than `MIN_VALUES`. If all values are
    equal, it is 0 within the margin, else 1.

    Source: [schuirmann1987].
    """
    beyond = np.abs(mean) - margin
    with np.errstate(all="ignore"):
        p = np.where(spread > 0, stdtr(n - 1, beyond / spread * np.sqrt(n)), beyond > 0)
    return np.where(n >= MIN_VALUES, p, np.nan)


def holm(p: Floats) -> Floats:
    """Return Holm's corrected p of each test; NaN where there is none, which does not count.

    The chance that any true null hypothesis has a corrected p of at most 0.05 is at most 5 %,
    however the tests depend on one another. Of the m tests sorted by p, the i-th has the maximum of
    (m - j + 1) p_j over j <= i.

    Source: [holm1979].

    Examples:
        >>> holm(np.array([0.02, 0.9, np.nan, 0.01]))
        array([0.04, 0.9 ,  nan, 0.03])
    """
    order = np.argsort(p)  # NaN is last
    m = np.count_nonzero(~np.isnan(p))
    corrected = np.full_like(p, np.nan)
    ranked = np.maximum.accumulate(np.arange(m, 0, -1) * p[order[:m]])
    corrected[order[:m]] = np.minimum(1.0, ranked)
    return corrected


def false_discovery_rates(p: Floats) -> Floats:
    """Return q of each test: the least false discovery rate at which it counts as a discovery.

    Of the m tests sorted by p, q of the i-th is the minimum of p_j m / j over j >= i. It holds for
    tests that are independent or positively dependent. NaN is no test.

    Source: [benjamini1995].

    Examples:
        >>> false_discovery_rates(np.array([0.02, 0.9, np.nan, 0.01]))
        array([0.03, 0.9 ,  nan, 0.03])
    """
    q = np.full_like(p, np.nan)
    tested = ~np.isnan(p)
    if tested.any():
        # Not at the top: the import takes 0.7 s, and a report of one replicate has no tests.
        from scipy.stats import false_discovery_control

        q[tested] = false_discovery_control(p[tested])
    return q
