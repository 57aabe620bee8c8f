"""How a number is written, and what is said of it."""

import math
from typing import Any

import pytest

from tests.evaluation.test_metrics import MORE_IS_BETTER
from xrgs.evaluation.metrics import METRICS, Metric
from xrgs.report.writing import (
    Change,
    arrow,
    interval,
    lacking,
    marked,
    number,
    p_value,
    same_sign,
    signed,
    verdict,
)

BY_NAME = {metric.name: metric for metric in METRICS}


def change(mean: float, low: float = math.nan, high: float = math.nan, **more: Any) -> Change:
    row: dict[str, Any] = dict.fromkeys(Change._fields, math.nan)
    row |= {"change": mean, "low": low, "high": high, "n": 1 if math.isnan(low) else 3}
    row |= {"unit": "replicates", "scenes": 3, "why": "", "outcome": True}
    return Change(**row | more)


@pytest.mark.parametrize("metric", METRICS, ids=lambda metric: metric.name)
def test_arrows_point_up_where_it_got_better(metric: Metric) -> None:
    more = MORE_IS_BETTER[metric.name]
    assert arrow(5.0, metric) == ("↑" if more else "↓")
    assert arrow(-5.0, metric) == ("↓" if more else "↑")
    assert arrow(0.0, metric) == "="
    assert arrow(-0.004, metric) == "="  # what is printed is 0.00
    assert arrow(math.nan, metric) == " "


@pytest.mark.parametrize(
    ("value", "text"),
    [(-44.566, "-44.57"), (0.45, "+0.45"), (-0.001, "0.00"), (0.0, "0.00"), (-0.0, "0.00"),
     (12345.678, "+12,345.68"), (math.nan, "n/a")],
)  # fmt: skip
def test_changes_are_signed(value: float, text: str) -> None:
    assert signed(value) == text


@pytest.mark.parametrize(
    ("value", "unit", "text"),
    [
        (83.456, "s", "83 s"),
        (1234.5, "s", "1,234 s"),
        (56812.0, "", "56,812"),
        (812.25, "", "812"),  # a mean of counts
        (12_345_678.0, "", "12.3 M"),
        (999_400_000.0, "", "999 M"),
        (999_600_000.0, "", "1.00 G"),
        (17_901_503_296.0, "", "17.9 G"),
        (1.302e12, "", "1.30 T"),
        (0.81234, "", "0.8123"),
        (24.0, "dB", "24.00 dB"),
        (3 * 2**20, "bytes", "3.0 MiB"),
        (math.inf, "dB", "inf dB"),
        (math.nan, "dB", "n/a"),
    ],
)
def test_values_have_their_unit(value: float, unit: str, text: str) -> None:
    assert number(value, unit) == text


SURE = {"low": 1.0, "high": 9.0, "q": 0.01}


@pytest.mark.parametrize(
    ("row", "text"),
    [
        (change(5.0), "one replicate: no interval"),
        (change(5.0, **SURE), "better"),
        (change(-5.0, **SURE), "worse"),
        (change(5.0, **SURE | {"q": 0.05}), "better"),
        (change(5.0, **SURE | {"q": 0.051}), "not shown"),
        (change(5.0, **SURE | {"q": math.nan}), "not shown"),  # two values
        (change(5.0, **SURE, holm=0.06), "not shown"),
        (change(5.0, **SURE | {"q": 0.06}, holm=0.05), "better"),
        (change(5.0, **SURE, p_equivalent=0.05), "equivalent"),  # surely better, by next to nothing
        (change(5.0, **SURE | {"q": 0.9}, p_equivalent=0.051), "not shown"),
        (change(5.0, **SURE, outcome=False), "descriptive"),
        (change(math.nan, why="not measured"), "n/a: not measured"),
    ],
)
def test_what_the_tests_allow_to_be_said_of_psnr(row: Change, text: str) -> None:
    assert verdict(row, BY_NAME["psnr"]) == text
    if text in {"better", "worse"}:  # fewer Gaussians are better
        assert {text, verdict(row, BY_NAME["gaussians"])} == {"better", "worse"}


@pytest.mark.parametrize(
    ("mean", "up", "down", "text"),
    [(1.0, 3, 1, "3 of 5 (0.625)"), (-1.0, 3, 1, "1 of 5 (0.625)"), (0.0, 2, 1, "2 of 5 (0.625)")],
)
def test_values_are_counted_by_the_sign_of_their_mean(
    mean: float, up: int, down: int, text: str
) -> None:
    assert same_sign(change(mean, up=up, down=down, n=5, p_sign=0.625)) == text
    assert same_sign(change(mean, up=up, down=down, n=1, p_sign=1.0)) == ""


def test_p_has_three_decimals_and_an_interval_two_signed_ends() -> None:
    assert [p_value(p) for p in (0.0004, 0.05, math.nan)] == ["<0.001", "0.050", ""]
    assert interval(-1.204, 3.4) == "-1.20 to +3.40"
    assert interval(math.nan, math.nan) == ""


@pytest.mark.parametrize(("scenes", "text"), [(0, ""), (2, " (2 of 3)"), (3, "")])
def test_a_mean_that_lacks_a_scene_says_so(scenes: int, text: str) -> None:
    assert lacking(change(5.0, scenes=scenes), 3) == text
    row = change(5.0, **SURE, scenes=scenes)
    assert marked(row, BY_NAME["psnr"], 3) == f"+5.00 ↑ *{text}"
    equivalent = row._replace(p_equivalent=0.01)
    assert marked(equivalent, BY_NAME["psnr"], 3) == f"+5.00 ↑ ≈{text}"
    assert marked(row._replace(q=0.9), BY_NAME["psnr"], 3) == f"+5.00 ↑{text}"
    assert marked(None, BY_NAME["psnr"], 3) == "missing"
