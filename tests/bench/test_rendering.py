"""The errors and the shortcuts of rendering that the benchmark measures."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any

import pytest
import torch

from xrgs.bench import rendering
from xrgs.bench.loads import Load, random_load
from xrgs.bench.rendering import RenderMethod, RenderTask, time_interleaved, use_threads
from xrgs.splat.backend import resolve_backend
from xrgs.splat.settings import CullingOptions, RasterSettings

BACKEND = resolve_backend("auto")


def test_tasks_run_in_turn_and_the_number_of_threads_is_restored() -> None:
    ran: list[str] = []
    tasks = {"a": lambda: ran.append("a"), "b": lambda: ran.append("b")}
    times = time_interleaved(tasks, repeats=3)
    assert "".join(ran) == "ab" + "ababab"  # once to warm up
    assert [len(times[name]) for name in "ab"] == [3, 3]
    before = torch.get_num_threads()
    with use_threads(before + 1):
        assert torch.get_num_threads() == before + 1
    assert torch.get_num_threads() == before


def test_float64_is_the_reference_of_errors(load: Load) -> None:
    method = RenderMethod("exact", "torch", dtype=torch.float64)
    assert max(rendering.errors(load, [method])["exact"].values()) < 1e-12


def test_errors_tell_wrong_settings_from_right_ones(load: Load) -> None:
    wrong = RenderMethod("wrong", "torch", RasterSettings(eps2d=0.6))
    found = rendering.errors(load, [RenderMethod("right", "torch"), wrong])
    for name, most, least in (("image_mean_error", 1e-6, 1e-3), ("gradient_error", 1e-3, 1e-2)):
        assert found["right"][name] < most
        assert found["wrong"][name] > least


def test_loads_too_large_for_torch_are_left_out() -> None:
    large = random_load(10, 600, 500, seed=0)
    assert rendering.time_load(large, [RenderMethod("torch", "torch")], [1], repeats=1) == []


def test_a_rendering_gives_six_gradients(load: Load) -> None:
    _, *gradients = RenderTask(load, RenderMethod("torch", "torch"), 1).results()
    assert [g.shape for g in gradients] == [p.shape for p in load.parameters]
    assert all(g.abs().max() > 0 for g in gradients)


@pytest.fixture(scope="module")
def shortcuts() -> dict[str, dict[str, Any]]:
    """Shortcuts on a load with a third out of view and a third below `alpha_min`."""
    load = random_load(300, 120, 90, seed=0)
    means, opacities = load.means.clone(), load.opacities.clone()
    means[:100, 0] += 50
    opacities[100:200] = 1e-4
    wide = replace(load, means=means, opacities=opacities)
    rows = rendering.time_shortcuts(wide, BACKEND, repeats=1)
    return {row["shortcut"]: row for row in rows}


def test_each_shortcut_is_timed_and_keeps_the_error(shortcuts: dict[str, Any]) -> None:
    native = {field.name.replace("_", " ") for field in fields(CullingOptions)}
    assert set(shortcuts) == {rendering.INACTIVE_BANDS} | (native if BACKEND == "native" else set())
    for row in shortcuts.values():
        for side in ("on", "off"):
            assert min(row[f"{side}_forward_ms"], row[f"{side}_backward_ms"]) > 0
            assert row[f"{side}_image_mean_error"] < 1e-6
            assert row[f"{side}_gradient_error"] < 1e-2
        assert row["on_evaluations"] <= row["off_evaluations"]
    assert shortcuts[rendering.INACTIVE_BANDS]["same_bits"] is True
    if blocks := shortcuts.get("blocks"):
        assert blocks["on_evaluations"] < 0.8 * blocks["off_evaluations"]
