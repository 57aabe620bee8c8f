"""What the plot of a benchmark shows, from made-up results."""

from __future__ import annotations

from typing import Any

import pytest

from xrgs.bench import growth, panels
from xrgs.report.bench_plot import Panel, RatioPanel

METHODS = ("native", "native, stop at 1e-2", "torch", "torch float64")


def made_up_row(method: str, gaussians: int, side: int, threads: int = 1) -> dict[str, Any]:
    return {
        "method": method,
        "backend": "torch" if method.startswith("torch") else "native",
        "load": "random",
        "threads": threads,
        "gaussians": gaussians,
        "width": side,
        "height": side,
        "forward_ms": gaussians * side * (1 + METHODS.index(method)) / threads,
        "backward_ms": 0.0,
        "error": {"image_mean": 0.0 if method == METHODS[-1] else 1e-7},
    }


@pytest.fixture
def results() -> dict[str, Any]:
    """Three loads, the largest of them without torch; two shortcuts at two sizes."""
    rows = [
        made_up_row(method, count, side, threads)
        for count, side in ((10, 8), (20, 8), (20, 16))
        for method in METHODS[: 4 if side == 8 else 2]
        for threads in (1, 2)
    ]
    renders = [
        {"shortcut": name, "width": side, "height": side, "gaussians": 20, "times": side / 4}
        for side in (8, 4)
        for name in ("tiles", "blocks")
    ]
    fits = growth.fit_growth(rows, "native", 1)
    return {"rows": rows, "shortcuts": {"renders": renders}, "growth": fits}


def test_one_panel_answers_each_question(results: dict[str, Any]) -> None:
    backends, cutoffs, shortcuts, by_gaussians, by_pixels = panels.panels(results)
    assert isinstance(backends, Panel)
    assert isinstance(cutoffs, Panel)
    assert isinstance(shortcuts, RatioPanel)
    assert isinstance(by_gaussians, Panel)
    assert isinstance(by_pixels, Panel)
    # The largest load that torch was timed on, and one thread.
    marks = {mark.label: (mark.x, mark.y) for mark in backends.marks}
    assert marks == {"native float32": (1e-7, 160.0), "torch float32": (1e-7, 480.0)}
    assert [(level.label, level.y) for level in backends.levels] == [
        ("torch float64, the reference", 640.0)
    ]
    assert "20 Gaussians, 8x8" in backends.xlabel
    assert [mark.label for mark in cutoffs.marks] == ["gsplat's settings", "stop at 1e-2"]
    assert shortcuts.series == ("8x8", "4x4")
    assert shortcuts.ratios == {"tiles": (2.0, 1.0), "blocks": (2.0, 1.0)}
    assert [line.label for line in by_gaussians.lines] == ["8x8: N$^{1.00}$"]
    assert "N$^{1.00}$" in by_gaussians.note
    assert [line.label for line in by_pixels.lines] == ["20 Gaussians: pixels$^{0.50}$"]


def test_a_single_load_shows_no_growth(results: dict[str, Any]) -> None:
    results["rows"] = results["rows"][:8]
    results["growth"] = {}
    assert len(panels.panels(results)) == 3


def test_a_single_backend_is_not_compared(results: dict[str, Any]) -> None:
    results["rows"] = results["rows"][:4]
    results["growth"] = {}
    cutoffs, _ = panels.panels(results)
    assert isinstance(cutoffs, Panel)
    assert [mark.label for mark in cutoffs.marks] == ["gsplat's settings", "stop at 1e-2"]
