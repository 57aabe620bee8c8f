"""Sizes, ages and durations for people; tables have their tests in tests/report/test_render.py."""

from __future__ import annotations

import pytest

from xrgs.runtime.text import (
    TextTable,
    format_age,
    format_duration,
    format_size,
    listed,
    to_text,
    width,
)


@pytest.mark.parametrize(
    ("seconds", "text"),
    [
        (None, "?"),
        (0.4, "~0 s"),
        (99, "~99 s"),
        (100, "~2 min"),
        (5400, "~90 min"),
        (9000, "~2.5 h"),
    ],
)
def test_duration(seconds: float | None, text: str) -> None:
    assert format_duration(seconds) == text


@pytest.mark.parametrize(
    ("count", "text"),
    [
        (None, "unknown"),
        (0, "0 B"),
        (999, "999 B"),
        (999.6, "1 kB"),
        (12_345_678, "12 MB"),
        (999_600_000, "1.0 GB"),
        (2_500_000_000_000, "2500.0 GB"),
    ],
)
def test_size(count: float | None, text: str) -> None:
    assert format_size(count) == text


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(None, "?"), (59.4, "59 s"), (60, "1 min"), (7200, "2 h"), (3 * 86400, "3 d")],
)
def test_age(seconds: float | None, text: str) -> None:
    assert format_age(seconds) == text


def test_text_is_aligned() -> None:
    rows = (("PSNR", "-0.80 ↓"), ("[odd]", "n/a"))
    table = TextTable("a_b & c", ("Metric", "50% | x"), rows, "lr", ("100 $",))
    assert to_text(table) == (
        "a_b & c\n\nMetric  50% | x\n──────  ───────\nPSNR    -0.80 ↓\n[odd]       n/a\n100 $\n"
    )


def test_wide_characters_keep_the_columns() -> None:
    table = TextTable("t", ("a", "b"), (("部屋", "1"), ("cafe\u0301", "2"), ("plain", "3")), "lr")
    lines = to_text(table).splitlines()[2:]
    assert len({width(line) for line in lines}) == 1


def test_listed_names_say_how_many_are_not_shown() -> None:
    assert listed(["a", "b"]) == "a, b"
    assert listed(["a", "b", "c"], most=2) == "a, b and 1 more"
