"""Sizes, ages and durations for people; tables have their tests in tests/report/test_render.py."""

from __future__ import annotations

from xrgs.runtime.text import (
    TextTable,
    format_age,
    format_duration,
    format_size,
    to_text,
    width,
)


def test_durations_sizes_and_ages() -> None:
    seconds = (None, 0.4, 99, 100, 5400, 9000)
    expected = ["?", "~0 s", "~99 s", "~2 min", "~90 min", "~2.5 h"]
    assert [format_duration(value) for value in seconds] == expected
    counts = (None, 0, 999, 999.6, 12_345_678, 999_600_000, 2_500_000_000_000)
    expected = ["unknown", "0 B", "999 B", "1 kB", "12 MB", "1.0 GB", "2500.0 GB"]
    assert [format_size(count) for count in counts] == expected
    ages = [format_age(value) for value in (None, 59.4, 60, 7200, 3 * 86400)]
    assert ages == ["?", "59 s", "1 min", "2 h", "3 d"]


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
