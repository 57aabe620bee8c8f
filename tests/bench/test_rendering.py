"""The errors, the shortcuts and the growth of rendering that the benchmark measures."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

import pytest
import torch

from xrgs.bench import rendering
from xrgs.bench.loads import Load, random_load
from xrgs.bench.rendering import ALL_LOADS, RenderMethod, fit_growth
from xrgs.bench.timing import time_interleaved
from xrgs.splat.backend import resolve_backend
from xrgs.splat.settings import CullingOptions, RasterSettings

BACKEND = resolve_backend("auto")


def test_tasks_run_in_turn_and_the_number_of_threads_is_restored() -> None:
    ran: list[str] = []
    before = torch.get_num_threads()
    tasks = {
        name: (threads, lambda name=name: ran.append(f"{name}{torch.get_num_threads()}"))
        for name, threads in (("a", before), ("b", before + 1))
    }
    times = time_interleaved(tasks, repeats=3)
    assert ran == 4 * [f"a{before}", f"b{before + 1}"]  # once to warm up
    assert [len(times[name]) for name in "ab"] == [3, 3]
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


@pytest.fixture(scope="module")
def shortcuts() -> dict[str, dict[str, Any]]:
    """Shortcuts on a load with a third out of view and a third below `alpha_min`."""
    load = random_load(300, 120, 90, seed=0)
    load.gaussians.means[:100, 0] += 50
    load.gaussians.opacities[100:200] = 1e-4
    rows = rendering.time_shortcuts(load, BACKEND, repeats=1)
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
