"""Ideal instruction counts against the equations, and shares of the peak against made-up times."""

from __future__ import annotations

from typing import Any

import pytest

from xrgs.bench import instructions, loads
from xrgs.bench.rendering import RenderMethod, time_methods
from xrgs.splat.backend import resolve_backend


def made_up_row(**work: int) -> dict[str, Any]:
    return {"gaussians": 0, "pairs": 0, "evaluations": 0} | work


def test_an_alpha_needs_the_products_of_its_equations() -> None:
    """At one vector of pixels, with the equations of docs/rasterizer.md.

    u, v and the exponent (Eq. 7 and 8) have 5 products, 2^x a polynomial of degree 6; alpha T and
    the three colours (Eq. 14 and 15) have 4 more. Going back, R and g (Eq. 17) have 2, dL/dw 3, the
    nine moments and three colours (Eq. 18) 4 for each of three products of 4x4 matrices.
    """
    row = made_up_row(evaluations=16)
    assert instructions.ideal_counts("composite", row)[1] == 5 + 6 + 4
    assert instructions.ideal_counts("composite_backward", row)[1] == 5 + 6 + 1 + 2 + 3 + 3 * 4


@pytest.mark.parametrize("stage", instructions.STAGES)
def test_multiplications_are_a_part_of_all_instructions(stage: str) -> None:
    row = made_up_row(gaussians=16, pairs=16, evaluations=16)
    total, multiply = instructions.ideal_counts(stage, row)
    assert 0 < multiply < total
    doubled = {key: 2 * value for key, value in row.items()}
    assert instructions.ideal_counts(stage, doubled) == (2 * total, 2 * multiply)


def test_a_share_is_the_time_at_the_peak_over_the_time_measured() -> None:
    row = made_up_row(evaluations=16_000, pairs=1600, gaussians=160)
    row["stages_ms"] = dict.fromkeys(instructions.STAGES, 2.0)
    shares = instructions.shares_of_peak(row, multiply_adds_per_s=16e9)  # 1e6 vectors a millisecond
    total, multiply = instructions.ideal_counts("composite", row)
    assert shares["composite"] == pytest.approx((total / 2e6, multiply / 2e6))


def test_the_native_backend_reports_every_unit_of_work() -> None:
    if resolve_backend("auto") != "native":
        pytest.skip("the native backend was not built")
    load = loads.random_load(150, 40, 30, seed=0)
    row = time_methods(load, [RenderMethod("native", "native")], [1], 1)["native", 1]
    for works in instructions.STAGES.values():
        assert all(row[work.unit] > 0 for work in works)
    assert set(instructions.STAGES) <= set(row["stages_ms"])
    # A pair is a tile of 16 blocks of 16 pixels at most.
    assert row["evaluations"] <= 256 * row["pairs"]
