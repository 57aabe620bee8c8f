"""The statistics of a report, against scipy's and closed forms."""

import math
from itertools import combinations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from xrgs.report.inference import (
    MIN_VALUES,
    NOT_FINITE,
    NOT_MEASURED,
    NOT_POSITIVE,
    WRONG_GAP,
    difference,
    equivalence,
    false_discovery_rates,
    half_width,
    holm,
    log_ratio,
    p_values,
    prediction_half_width,
    share_of_gap,
    sign_test,
)

#: Values that scatter: scipy warns of precision that is lost where they are nearly equal.
SCATTERED = st.lists(st.floats(-100, 100), min_size=MIN_VALUES, max_size=20).filter(
    lambda values: np.std(values) > 1e-6 * max(map(abs, values))
)
P = st.floats(0, 1)


def summed_up(values: list[float]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mean, standard deviation and number, as arrays of one."""
    return (
        np.array([np.mean(values)]),
        np.array([np.std(values, ddof=1)]),
        np.array([float(len(values))]),
    )


@given(st.lists(st.floats(-1e300, 1e300), min_size=1))
def test_a_base_against_itself_is_zero(values: list[float]) -> None:
    for changed in (difference, log_ratio):
        change, why = changed(np.array(values), np.array(values))
        assert np.array_equal(change, np.zeros(len(values)))
        assert set(why) == {""}


@pytest.mark.parametrize(
    ("base", "value", "why"),
    [
        (math.nan, 1.0, NOT_MEASURED),
        (1.0, math.nan, NOT_MEASURED),
        (math.inf, 1.0, NOT_FINITE),
        (1.0, math.inf, NOT_FINITE),
        (math.inf, math.inf, NOT_FINITE),
    ],
)
def test_where_there_is_no_difference_the_reason_is_given(
    base: float, value: float, why: str
) -> None:
    change, found = difference(np.array([base]), np.array([value]))
    assert math.isnan(change[0])
    assert list(found) == [why]


@given(st.lists(st.floats(-100, 100), min_size=2, max_size=40))
def test_the_interval_is_scipys(values: list[float]) -> None:
    spread = float(np.std(values, ddof=1))
    found = half_width(np.array([spread]), np.array([float(len(values))]))[0]
    wanted = stats.t.ppf(0.975, len(values) - 1) * spread / math.sqrt(len(values))
    assert found == pytest.approx(wanted, rel=1e-9)


def test_less_is_a_gap_where_less_is_better() -> None:
    args = np.array([0.4]), np.array([0.1]), np.array([0.2])
    assert share_of_gap(*args, higher_is_better=False)[0] == pytest.approx([150.0])
    assert share_of_gap(*args, higher_is_better=True)[1] == [WRONG_GAP]


def test_the_log_of_a_ratio_is_the_same_up_and_down() -> None:
    ratio, why = log_ratio(np.array([100.0, 100.0, 0.0]), np.array([200.0, 50.0, 0.0]))
    assert list(why) == ["", "", ""]
    assert ratio == pytest.approx([math.log(2), -math.log(2), 0.0], rel=1e-15)


@given(st.floats(1e-100, 1e100), st.floats(1e-100, 1e100))
def test_a_known_ratio_is_numpys(base: float, value: float) -> None:
    ratio, why = log_ratio(np.array([base]), np.array([value]))
    assert list(why) == [""]
    wanted = np.log(np.longdouble(value) / np.longdouble(base))
    assert ratio[0] == pytest.approx(float(wanted), rel=1e-12, abs=1e-15)


@pytest.mark.parametrize(
    ("base", "value", "why"),
    [
        (1.0, 0.0, NOT_POSITIVE),
        (-1.0, 2.0, NOT_POSITIVE),
        (-2.0, -1.0, NOT_POSITIVE),
        (math.nan, 1.0, NOT_MEASURED),
        (1.0, math.inf, NOT_FINITE),
        (math.inf, math.inf, NOT_FINITE),
    ],
)
def test_where_there_is_no_ratio_the_reason_is_given(base: float, value: float, why: str) -> None:
    ratio, found = log_ratio(np.array([base]), np.array([value]))
    assert math.isnan(ratio[0])
    assert list(found) == [why]


@given(SCATTERED)
def test_p_is_scipys(values: list[float]) -> None:
    found = p_values(*summed_up(values))
    assert found[0] == pytest.approx(stats.ttest_1samp(values, 0).pvalue, rel=1e-6, abs=1e-300)


def test_two_values_and_equal_values_are_not_tested() -> None:
    n = np.array([1.0, 2.0, 3.0, 3.0, 3.0])
    mean, spread = np.array([1.0, 1.0, 0.0, 0.0, 1.0]), np.array([np.nan, 1.0, 0.0, 1.0, 0.0])
    found = p_values(mean, spread, n)
    assert found == pytest.approx([np.nan, np.nan, np.nan, 1, 0], nan_ok=True)


def test_the_prediction_interval_holds_one_more_value_95_times_in_100() -> None:
    drawn = np.random.default_rng(0).normal(3.0, 2.0, (20_000, 8))
    seen, new = drawn[:, :7], drawn[:, 7]
    n = np.full(len(seen), 7.0)
    half = prediction_half_width(seen.std(axis=1, ddof=1), n)
    inside = np.abs(new - seen.mean(axis=1)) <= half
    assert inside.mean() == pytest.approx(0.95, abs=0.005)  # 3 standard errors


def test_the_prediction_interval_is_its_formula() -> None:
    n = np.array([2.0, 3.0, 7.0])
    wanted = [math.nan, *(stats.t.ppf(0.975, m - 1) * 1.5 * math.sqrt(1 + 1 / m) for m in n[1:])]
    assert prediction_half_width(np.full(3, 1.5), n) == pytest.approx(wanted, nan_ok=True)


@given(st.integers(0, 30), st.integers(0, 30))
def test_the_sign_test_is_scipys(up: int, down: int) -> None:
    found = float(sign_test(np.array([float(up)]), np.array([float(down)]))[0])
    wanted = stats.binomtest(up, up + down).pvalue if up + down else 1.0
    assert found == pytest.approx(wanted, rel=1e-9)


@given(SCATTERED, st.floats(0, 50))
def test_equivalence_is_two_one_sided_t_tests(values: list[float], margin: float) -> None:
    found = equivalence(*summed_up(values), np.array([margin]))[0]
    above = stats.ttest_1samp(values, -margin, alternative="greater").pvalue
    below = stats.ttest_1samp(values, margin, alternative="less").pvalue
    assert found == pytest.approx(max(above, below), rel=1e-6, abs=1e-12)


def test_equal_values_are_equivalent_within_the_margin_alone() -> None:
    mean, margin = np.array([0.0, 0.1, 0.3, 0.0]), np.array([0.0, 0.2, 0.2, 0.2])
    n = np.array([3.0, 3.0, 3.0, 2.0])
    found = equivalence(mean, np.zeros(4), n, margin)
    assert found == pytest.approx([0, 0, 1, math.nan], nan_ok=True)


@given(st.lists(st.one_of(P, st.just(math.nan)), max_size=7))
def test_holm_is_closed_testing_with_bonferroni(values: list[float]) -> None:
    """A hypothesis is rejected where every intersection that it is part of is: all subsets."""
    p = np.array(values, np.float64)
    known = np.flatnonzero(~np.isnan(p))
    found = holm(p)
    assert np.array_equal(np.isnan(found), np.isnan(p))
    for one in known:
        subsets = [
            of for size in range(1, len(known) + 1) for of in combinations(known, size) if one in of
        ]
        wanted = max(min(1.0, len(of) * p[list(of)].min()) for of in subsets)
        assert found[one] == pytest.approx(wanted, rel=1e-12)


@given(st.lists(st.one_of(P, st.just(math.nan)), max_size=40))
def test_false_discovery_rates_are_their_definition(values: list[float]) -> None:
    """Of m sorted p, the least p_j m / j over j >= i, at most 1; NaN is no test."""
    p = np.array(values, np.float64)
    known = np.sort(p[~np.isnan(p)])
    q = false_discovery_rates(p)
    assert np.array_equal(np.isnan(q), np.isnan(p))
    for one, of in zip(p[~np.isnan(p)], q[~np.isnan(p)], strict=True):
        ranked = [other * len(known) / j for j, other in enumerate(known, 1) if other >= one]
        assert of == pytest.approx(min(1.0, *ranked), rel=1e-12)


def test_the_example_of_benjamini_and_hochberg() -> None:
    """Of the 15 values of p of their section 3.2, the four smallest are discoveries at 5 %."""
    p = [0.0001, 0.0004, 0.0019, 0.0095, 0.0201, 0.0278, 0.0298, 0.0344, 0.0459, 0.3240]
    p += [0.4262, 0.5719, 0.6528, 0.7590, 1.0000]
    assert list(false_discovery_rates(np.array(p[::-1]))[::-1] <= 0.05) == [True] * 4 + [False] * 11
