"""Power laws are found in made-up times whose exponents are known."""

from __future__ import annotations

from typing import Any

import pytest

from xrgs.bench import growth

GAUSSIANS, SIDES = (10, 100, 1000), (10, 20)


def made_up_rows() -> list[dict[str, Any]]:
    """Times that grow with Gaussians^0.8 and pixels^0.5, of one thread, and others of two."""
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


def test_one_exponent_of_each_size_is_fitted_to_all_loads() -> None:
    rows = made_up_rows()
    found = growth.fit_growth(rows, "native", 1)
    assert found["gaussians"] == pytest.approx(0.8)
    assert found["pixels"] == pytest.approx(0.5)
    assert growth.fit_growth(rows[:1], "native", 1) == {}
    assert growth.fit_growth(rows, "torch", 1) == {}


def test_a_fit_is_the_least_squares_of_the_logarithms() -> None:
    assert growth.fit_exponent([1, 10, 100], [3, 30, 300]) == pytest.approx(1)
    # The middle point of three equidistant ones does not change the slope.
    assert growth.fit_exponent([1, 10, 100], [1, 50, 10]) == pytest.approx(0.5)


def test_each_image_size_has_its_growth_with_gaussians() -> None:
    found = growth.growth_by_gaussians(made_up_rows(), "native", 1)
    assert [line.fixed for line in found] == ["10x10", "20x20"]
    for line, side in zip(found, SIDES, strict=True):
        assert line.sizes == GAUSSIANS
        assert line.ms == pytest.approx([3e-3 * count**0.8 * side for count in GAUSSIANS])
        assert line.exponent == pytest.approx(0.8)


def test_each_number_of_gaussians_has_its_growth_with_pixels() -> None:
    found = growth.growth_by_pixels(made_up_rows(), "native", 1)
    assert [line.fixed for line in found] == ["10", "100", "1,000"]
    for line in found:
        assert line.sizes == (100, 400)
        assert line.exponent == pytest.approx(0.5)


def test_a_single_load_has_no_growth() -> None:
    rows = made_up_rows()[:1]
    assert growth.growth_by_gaussians(rows, "native", 1) == []
    assert growth.growth_by_pixels(rows, "native", 1) == []
