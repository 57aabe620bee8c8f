"""Power laws are found in made-up times with known exponents."""

from __future__ import annotations

from typing import Any

import pytest

from xrgs.bench.plot import ALL_LOADS, fit_growth

GAUSSIANS, SIDES = (10, 100, 1000), (10, 20)


def made_up_rows() -> list[dict[str, Any]]:
    """Times on one thread that grow with Gaussians^0.8 and pixels^0.5, and others on two."""
    return [
        {
            "method": "native",
            "threads": threads,
            "gaussians": count,
            "width": side,
            "height": side,
            "forward_ms": 1e-3 * count**0.8 * side / threads**2,
            "backward_ms": 2e-3 * count ** (0.8 if threads == 1 else 0.1) * side,
        }
        for threads in (1, 2)
        for count in reversed(GAUSSIANS)
        for side in SIDES
    ]


def test_each_size_has_an_exponent() -> None:
    found = {(row["grows"], row["at"]): row for row in fit_growth(made_up_rows())}
    counts = [f"{count:,} Gaussians" for count in GAUSSIANS]
    keys = [("Gaussians", "10x10"), ("Gaussians", "20x20"), *(("pixels", at) for at in counts)]
    assert list(found) == [*keys, ("Gaussians", ALL_LOADS), ("pixels", ALL_LOADS)]
    for (grows, _), row in found.items():
        assert row["exponent"] == pytest.approx(0.8 if grows == "Gaussians" else 0.5)
    larger = found["Gaussians", "20x20"]
    assert larger["sizes"] == list(GAUSSIANS)
    assert larger["ms"] == pytest.approx([3e-3 * count**0.8 * 20 for count in GAUSSIANS])
    assert found["pixels", "10 Gaussians"]["sizes"] == [100, 400]


def test_a_fit_is_the_least_squares_of_the_logarithms() -> None:
    rows = [row for row in made_up_rows() if row["width"] == 10]
    for row in rows:
        row["forward_ms"], row["backward_ms"] = {10: 1, 100: 50, 1000: 10}[row["gaussians"]], 0
    assert fit_growth(rows[:1]) == [], "of a single load"
    # The middle one of three equidistant points does not change the slope.
    assert [row["exponent"] for row in fit_growth(rows)] == [pytest.approx(0.5)]
