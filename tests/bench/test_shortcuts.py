"""Each shortcut saves work, and changes no bit unless it says so."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any

import pytest
import torch

from xrgs.bench import shortcuts
from xrgs.bench.loads import Load, random_load
from xrgs.splat.backend import resolve_backend
from xrgs.splat.settings import CullingOptions

BACKEND = resolve_backend("auto")


@pytest.fixture(scope="module")
def rows(wide: Load) -> dict[str, Any]:
    return {row["shortcut"]: row for row in shortcuts.time_renders(wide, BACKEND, repeats=1)}


@pytest.fixture(scope="module")
def wide() -> Load:
    """Return a load of which a third is out of view and a third below `alpha_min`."""
    load = random_load(300, 120, 90, seed=0)
    means, opacities = load.means.clone(), load.opacities.clone()
    means[:100, 0] += 50
    opacities[100:200] = 1e-4
    return replace(load, means=means, opacities=opacities)


def test_each_shortcut_is_timed_once(rows: dict[str, Any]) -> None:
    native = {field.name.replace("_", " ") for field in fields(CullingOptions)}
    assert set(rows) == {shortcuts.INACTIVE_BANDS} | (native if BACKEND == "native" else set())
    for row in rows.values():
        on, off = row["on"], row["off"]
        for side in (on, off):
            assert min(side["forward_ms"], side["backward_ms"]) > 0
            assert side["image_mean"] < 1e-6
            assert side["gradient"] < 1e-2
        assert on["evaluations"] <= off["evaluations"]


@pytest.mark.skipif(BACKEND == "torch", reason="the native backend was not built")
def test_culling_blocks_saves_alpha_evaluations(rows: dict[str, Any]) -> None:
    on, off = rows["blocks"]["on"], rows["blocks"]["off"]
    assert on["evaluations"] < 0.8 * off["evaluations"]


def test_inactive_bands_change_no_bit(rows: dict[str, Any]) -> None:
    assert rows[shortcuts.INACTIVE_BANDS]["same_bits"] is True


def test_a_prepared_target_changes_no_bit(load: Load) -> None:
    prepared, computed = (run() for run in shortcuts._statistics(load, BACKEND))
    assert torch.equal(prepared, computed)
    assert [row["part"] for row in shortcuts.time_steps(load, BACKEND, repeats=1)] == [
        "loss",
        "optimizer",
    ]


def test_the_optimizer_leaves_zero_moments_alone(load: Load) -> None:
    degree_0, degree_3 = shortcuts.before_and_after_bands(load, BACKEND)
    for step, moves in ((degree_0, False), (degree_3, True)):
        before = step.gaussians.shN.detach().clone()
        step.optimize()
        assert torch.equal(step.gaussians.shN, before) != moves
