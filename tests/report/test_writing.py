"""How a number is written, and what is said of it."""

import math
from typing import Any

import pytest

from tests.evaluation.test_metrics import MORE_IS_BETTER
from xrgs.evaluation.metrics import METRICS, Metric
from xrgs.report.writing import (
    Change,
    arrow,
    false_discovery,
    lacking,
    marked,
    number,
    reading,
    scatter,
    signed,
)

BY_NAME = {metric.name: metric for metric in METRICS}


def change(mean: float, low: float = math.nan, high: float = math.nan, **more: Any) -> Change:
    row: dict[str, Any] = dict.fromkeys(Change._fields, math.nan)
    row |= {"change": mean, "low": low, "high": high, "n": 1 if math.isnan(low) else 3}
    return Change(**row | {"unit": "replicates", "scenes": 3, "why": ""} | more)


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
        (8.3456, "s", "8.35 s"),
        (1234.5, "s", "1,234 s"),
        (56812.0, "", "56,812"),
        (9_999_999.0, "", "9,999,999"),
        (12_345_678.0, "", "12.3 M"),
        (999_400_000.0, "", "999 M"),
        (999_600_000.0, "", "1.00 G"),
        (17_901_503_296.0, "", "17.9 G"),
        (7.0, "", "7"),
        (0.81234, "", "0.8123"),
        (24.0, "dB", "24.00 dB"),
        (3 * 2**20, "bytes", "3.0 MiB"),
        (math.inf, "dB", "inf dB"),
        (math.nan, "dB", "n/a"),
    ],
)
def test_values_have_their_unit(value: float, unit: str, text: str) -> None:
    assert number(value, unit) == text


@pytest.mark.parametrize(
    ("row", "text"),
    [
        (change(5.0), "one replicate: no interval"),
        (change(5.0, 1.0, 9.0), "better"),
        (change(-5.0, -9.0, -1.0), "worse"),
        (change(5.0, -1.0, 11.0), "interval holds 0"),
        (change(5.0, 0.0, 10.0), "interval holds 0"),
        (change(0.0, 0.0, 0.0), "unchanged"),
        (change(0.0, -1.0, 1.0), "interval holds 0"),
        (change(0.002, 0.001, 0.003), "unchanged"),
        (change(math.nan, why="not measured"), "n/a: not measured"),
        (change(5.0, 1.0, 9.0, n=2), "two values: no verdict"),
        (change(5.0, -1.0, 11.0, n=2), "two values: no verdict"),
    ],
)
def test_what_an_interval_allows_to_be_said_of_psnr(row: Change, text: str) -> None:
    assert reading(row, BY_NAME["psnr"]) == text


def test_less_gaussians_outside_noise_are_better() -> None:
    assert reading(change(-5.0, -9.0, -1.0), BY_NAME["gaussians"]) == "better"


@pytest.mark.parametrize(
    ("q", "text"), [(0.0004, "<0.001 *"), (0.05, "0.050 *"), (0.0501, "0.050"), (math.nan, "")]
)
def test_a_star_is_where_q_is_at_most_5_percent(q: float, text: str) -> None:
    assert false_discovery(change(5.0, q=q)) == text
    assert ("*" in marked(change(5.0, q=q), BY_NAME["psnr"], 3)) == ("*" in text)


@pytest.mark.parametrize(("scenes", "text"), [(0, ""), (2, " (2 of 3)"), (3, "")])
def test_a_mean_that_lacks_a_scene_says_so(scenes: int, text: str) -> None:
    assert lacking(change(5.0, scenes=scenes), 3) == text
    assert marked(change(5.0, scenes=scenes, q=0.01), BY_NAME["psnr"], 3) == f"+5.00 ↑ *{text}"


def test_what_is_missing_has_no_mark() -> None:
    assert marked(None, BY_NAME["psnr"], 3) == "missing"


def test_a_deviation_has_no_sign() -> None:
    assert (scatter(1234.567), scatter(math.nan)) == ("1,234.57", "")
