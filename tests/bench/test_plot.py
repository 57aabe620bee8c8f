"""The plot of the benchmark shows the numbers of the results."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.patches import Rectangle

from xrgs.bench import plot
from xrgs.bench.rendering import fit_growth
from xrgs.bench.training import STEP_PARTS

METHODS = ("native", "native, stop at 1e-2", "torch", "torch float64")


def made_up_row(method: str, gaussians: int, side: int, threads: int) -> dict[str, Any]:
    return {
        "method": method,
        "backend": "torch" if method.startswith("torch") else "native",
        "threads": threads,
        "gaussians": gaussians,
        "width": side,
        "height": side,
        "forward_ms": gaussians * side * (1 + METHODS.index(method)) / threads,
        "backward_ms": 0.0,
        "image_mean_error": 0.0 if method == METHODS[-1] else 1e-7,
    }


@pytest.fixture
def results() -> dict[str, Any]:
    """Three loads, the largest of them without torch; two shortcuts at two sizes; two steps."""
    rows = [
        made_up_row(method, count, side, threads)
        for count, side in ((10, 8), (20, 8), (20, 16))
        for method in METHODS[: 4 if side == 8 else 2]
        for threads in (1, 2)
    ]
    shortcuts = [
        {"shortcut": name, "width": side, "height": side, "gaussians": 20, "times": side / 4}
        for side in (8, 4)
        for name in ("tiles", "blocks")
    ]
    parts = {f"{part}_ms": float(number) for number, part in enumerate(STEP_PARTS, start=1)}
    sizes = {"threads": 1, "gaussians": 20, "width": 8, "height": 8}
    steps = [{"view": view, **sizes, **parts} for view in ("HR", "LR")]
    return {"rows": rows, "shortcuts": shortcuts, "steps": steps, "growth": fit_growth(rows)}


def points(axes: Axes) -> dict[str, list[list[float]]]:
    return {str(line.get_label()): np.asarray(line.get_xydata()).tolist() for line in axes.lines}


def widths(axes: Axes) -> list[float]:
    return [bar.get_width() for bar in axes.patches if isinstance(bar, Rectangle)]


@pytest.mark.slow
def test_one_panel_answers_each_question(results: dict[str, Any]) -> None:
    backends, cutoffs, shortcuts, by_gaussians, by_pixels, steps = plot.draw(results).axes
    # The largest load that torch was timed on, and one thread.
    drawn = points(backends)
    assert drawn["native"] == [[1e-7, 160.0]]
    assert drawn["torch"] == [[1e-7, 480.0]]
    assert drawn["torch float64, the reference"][0][1] == 640.0
    assert "20 Gaussians, 1 thread, 8x8" in backends.get_xlabel()
    assert set(points(cutoffs)) == {"native", "native, stop at 1e-2"}
    assert widths(shortcuts) == [2.0, 2.0, 1.0, 1.0]  # size by size
    assert points(by_gaussians)["8x8: exponent 1.00"] == [[10, 80.0], [20, 160.0]]
    assert "all loads: exponent 1.00" in points(by_gaussians)
    assert points(by_pixels)["20 Gaussians: exponent 0.50"] == [[64, 160.0], [256, 320.0]]
    assert widths(steps) == [1, 1, 2, 2, 3, 3, 4, 4, 5, 5]  # part by part, one after the other
    starts = [bar.get_x() for bar in steps.patches if isinstance(bar, Rectangle)]
    assert starts == [0, 0, 1, 1, 3, 3, 6, 6, 10, 10]


def test_a_single_load_shows_no_growth(results: dict[str, Any]) -> None:
    results["rows"], results["growth"] = results["rows"][:8], []
    assert len(plot.draw(results).axes) == 4
