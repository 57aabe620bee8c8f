"""What is left out, on and off: the work it spares, and that it changes nothing it shouldn't."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any

import pytest
import torch

from xrgs.bench import skips
from xrgs.bench.loads import Load
from xrgs.splat.backend import resolve_backend
from xrgs.splat.settings import CullingOptions

BACKEND = resolve_backend("auto")


@pytest.fixture(scope="module")
def rows(wide: Load) -> dict[str, Any]:
    return {row["skip"]: row for row in skips.time_renders(wide, BACKEND, repeats=1)}


@pytest.fixture(scope="module")
def wide() -> Load:
    """A third of it out of view, a third under the cut."""
    from xrgs.bench.loads import random_load

    load = random_load(300, 120, 90, seed=0)
    means, opacities = load.means.clone(), load.opacities.clone()
    means[:100, 0] += 50
    opacities[100:200] = 1e-4
    return replace(load, means=means, opacities=opacities)


def test_each_skip_is_there_once(rows: dict[str, Any]) -> None:
    native = {field.name.replace("_", " ") for field in fields(CullingOptions)}
    assert set(rows) == {skips.BANDS} | (native if BACKEND == "native" else set())
    for row in rows.values():
        on, off = row["on"], row["off"]
        for side in (on, off):
            assert min(side["forward_ms"], side["backward_ms"]) > 0
            assert side["image_mean"] < 1e-6
            assert side["gradient"] < 1e-2
        assert on["evaluations"] <= off["evaluations"]


@pytest.mark.skipif(BACKEND == "torch", reason="the native backend was not built")
def test_blocks_spare_evaluations(rows: dict[str, Any]) -> None:
    on, off = rows["blocks"]["on"], rows["blocks"]["off"]
    assert on["evaluations"] < 0.8 * off["evaluations"]


def test_harmonics_of_zero_change_no_bit(rows: dict[str, Any]) -> None:
    assert rows[skips.BANDS]["same_bits"] is True


def test_statistics_at_hand_change_no_bit(load: Load) -> None:
    known, computed = (run() for run in skips._statistics(load, BACKEND))
    assert torch.equal(known, computed)
    assert [row["part"] for row in skips.time_steps(load, BACKEND, repeats=1)] == [
        "loss",
        "optimizer",
    ]


def test_zero_moments_are_left_alone(load: Load) -> None:
    bandless, full = skips.before_and_after_bands(load, BACKEND)
    for step, moves in ((bandless, False), (full, True)):
        before = step.gaussians.shN.detach().clone()
        step.optimize()
        assert torch.equal(step.gaussians.shN, before) != moves
