"""The statistics of a report, against scipy's and closed forms."""

import math
from itertools import pairwise

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
    ZERO_BASE,
    false_discovery_rates,
    half_width,
    log_ratio,
    p_values,
    percent_change,
    share_of_gap,
)

FLOATS = st.floats(-1e6, 1e6, allow_subnormal=False).filter(lambda x: abs(x) > 1e-6)
PAIRS = st.lists(st.tuples(FLOATS, FLOATS), min_size=1, max_size=20)


@given(PAIRS, st.integers(-40, 40))
def test_a_percentage_has_no_unit(pairs: list[tuple[float, float]], power: int) -> None:
    base, value = np.array(pairs).T
    scale = 2.0**power  # exact, so that the result must be too
    assert np.array_equal(
        percent_change(base, value)[0], percent_change(base * scale, value * scale)[0]
    )


@given(st.lists(st.floats(-1e300, 1e300), min_size=1))
def test_a_base_against_itself_is_zero(values: list[float]) -> None:
    change, why = percent_change(np.array(values), np.array(values))
    assert np.array_equal(change, np.zeros(len(values)))
    assert set(why) == {""}


@given(FLOATS, FLOATS)
def test_more_is_a_positive_change_even_below_zero(base: float, value: float) -> None:
    change = percent_change(np.array([base]), np.array([value]))[0][0]
    assert np.sign(change) == np.sign(value - base)


@pytest.mark.parametrize(
    ("base", "value", "why"),
    [
        (0.0, 1.0, ZERO_BASE),
        (0.0, math.inf, NOT_FINITE),
        (math.nan, 1.0, NOT_MEASURED),
        (1.0, math.nan, NOT_MEASURED),
        (math.inf, 1.0, NOT_FINITE),
        (1.0, math.inf, NOT_FINITE),
        (math.inf, math.inf, NOT_FINITE),
        (1e-300, 1e300, NOT_FINITE),
    ],
)
def test_where_there_is_no_percentage_the_reason_is_given(
    base: float, value: float, why: str
) -> None:
    change, found = percent_change(np.array([base]), np.array([value]))
    assert math.isnan(change[0])
    assert list(found) == [why]


@given(st.lists(st.floats(-100, 100), min_size=2, max_size=40))
def test_the_interval_is_scipys(values: list[float]) -> None:
    spread = float(np.std(values, ddof=1))
    found = half_width(np.array([spread]), np.array([float(len(values))]))[0]
    wanted = stats.t.ppf(0.975, len(values) - 1) * spread / math.sqrt(len(values))
    assert found == pytest.approx(wanted, rel=1e-9)


def test_more_values_make_a_narrower_interval() -> None:
    widths = half_width(np.ones(30), np.arange(1.0, 31.0))
    assert math.isnan(widths[0])
    assert all(wide > narrow for wide, narrow in pairwise(widths[1:]))


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
        (2.0, -1.0, NOT_POSITIVE),
        (-2.0, -1.0, NOT_POSITIVE),
        (0.0, 1.0, ZERO_BASE),
        (math.nan, 1.0, NOT_MEASURED),
        (1.0, math.inf, NOT_FINITE),
        (math.inf, math.inf, NOT_FINITE),
    ],
)
def test_where_there_is_no_ratio_the_reason_is_given(base: float, value: float, why: str) -> None:
    ratio, found = log_ratio(np.array([base]), np.array([value]))
    assert math.isnan(ratio[0])
    assert list(found) == [why]


@given(st.lists(st.floats(-100, 100), min_size=MIN_VALUES, max_size=20))
def test_p_is_scipys(values: list[float]) -> None:
    mean, spread = float(np.mean(values)), float(np.std(values, ddof=1))
    if spread <= 1e-9 * max(map(abs, values)):
        return  # scipy warns of precision that is lost
    found = p_values(np.array([mean]), np.array([spread]), np.array([float(len(values))]))
    assert found[0] == pytest.approx(stats.ttest_1samp(values, 0).pvalue, rel=1e-9, abs=1e-300)


def test_two_values_are_not_tested_and_no_change_is_certain() -> None:
    n = np.array([1.0, 2.0, 3.0, 3.0, 3.0])
    mean, spread = np.array([1.0, 1.0, 0.0, 0.0, 1.0]), np.array([np.nan, 1.0, 0.0, 1.0, 0.0])
    assert p_values(mean, spread, n) == pytest.approx([np.nan, np.nan, 1, 1, 0], nan_ok=True)


@given(st.lists(st.one_of(st.floats(0, 1), st.just(math.nan)), max_size=40))
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
