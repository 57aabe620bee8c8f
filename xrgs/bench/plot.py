"""Plots the results of the benchmark, with a panel for each question."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
import pandas as pd
from matplotlib import style
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter

from xrgs.bench.rendering import ALL_LOADS, TORCH_FLOAT64, total_ms
from xrgs.bench.timing import Row
from xrgs.bench.training import STEP_PARTS

_DPI = 150
_SIZE = (4.6, 4.2)  # of a panel, inches
_MIN_ERROR = 1e-9  # an error of 0 has no logarithm
_ROOM = 0.6  # beside bars for the legend, as a fraction of the longest bar
_TIME = "forward + backward, ms"


def draw(results: Mapping[str, Any]) -> Figure:
    """Plot the results of `xrgs.bench.run`, with a panel for each question.

    All panels except that of training steps are for one thread.
    """
    rows = [row for row in results["rows"] if row["threads"] == 1]
    load = largest_common_load(rows)
    first_method = rows[0]["method"]
    plain = [row for row in load if row["method"] in {row["backend"], TORCH_FLOAT64}]
    cutoffs = [row for row in load if f"{row['method']},".startswith(f"{first_method},")]
    panels: list[Callable[[Axes], None]] = [
        partial(_draw_errors, rows=plain, title="Which backend?", yscale="log"),
        partial(_draw_errors, rows=cutoffs, title="What do cutoffs cost?", yscale="linear"),
        partial(_draw_shortcuts, rows=results["shortcuts"]),
    ]
    if results["growth"]:
        panels += [
            partial(_draw_growth, rows=results["growth"], grows=grows)
            for grows in ("Gaussians", "pixels")
        ]
    panels.append(partial(_draw_steps, rows=results["steps"]))
    columns = len(panels) // 2
    with style.context("default"):  # independent of the user's style
        size = (_SIZE[0] * columns, _SIZE[1] * 2)
        figure = Figure(figsize=size, dpi=_DPI, layout="constrained")
        for number, panel in enumerate(panels, start=1):
            panel(figure.add_subplot(2, columns, number))
    return figure


def largest_common_load(rows: Sequence[Row]) -> list[Row]:
    """Return the rows of the largest load among those with times of the most methods."""
    groups: dict[tuple[int, int, int], list[Row]] = {}
    for row in rows:
        groups.setdefault((row["gaussians"], row["width"], row["height"]), []).append(row)
    key = max(groups, key=lambda sizes: (len(groups[sizes]), np.prod(sizes)))
    return groups[key]


def _draw_errors(axes: Axes, rows: Sequence[Row], title: str, yscale: str) -> None:
    for row in rows:
        if row["method"] == TORCH_FLOAT64:
            label = f"{TORCH_FLOAT64}, the reference"
            axes.axhline(total_ms(row), color="gray", linestyle="--", label=label)
        else:
            error = max(row["image_mean_error"], _MIN_ERROR)
            axes.plot(error, total_ms(row), "o", markersize=9, label=row["method"])
    axes.set(xscale="log", yscale=yscale, title=title, ylabel=_TIME)
    left, right = axes.dataLim.intervalx
    axes.set_xlim(left / 10, right * 10)  # errors are nearly equal, or decades apart
    axes.set_xlabel(f"mean error of the image\n{_describe(rows[0])}, {_size(rows[0])}")
    axes.margins(y=0.3)
    axes.legend()


def _draw_shortcuts(axes: Axes, rows: Sequence[Row]) -> None:
    frame = pd.DataFrame(
        {"shortcut": row["shortcut"], "size": _size(row), "times": row["times"]} for row in rows
    )
    times = frame.pivot_table("times", "shortcut", "size", sort=False)
    thickness = 0.8 / len(times.columns)
    for number, size in enumerate(times.columns):
        places = np.arange(len(times)) + thickness * number
        bars = axes.barh(places, times[size], thickness, label=size)
        axes.bar_label(bars, fmt="%.2f", padding=3)
    axes.set_yticks(np.arange(len(times)) + thickness * (len(times.columns) - 1) / 2, times.index)
    axes.invert_yaxis()
    axes.margins(x=_ROOM)
    axes.axvline(1.0, color="gray", zorder=0)
    axes.set(title="What do the shortcuts save?")
    axes.set_xlabel(f"time without it / with it\n{_describe(rows[0])}")
    axes.legend(loc="lower right")


def _draw_growth(axes: Axes, rows: Sequence[Row], grows: str) -> None:
    for row in rows:
        if row["grows"] != grows:
            continue
        label = f"{row['at']}: exponent {row['exponent']:.2f}"
        if row["at"] == ALL_LOADS:
            axes.plot([], [], " ", label=label)  # only an entry of the legend
        else:
            axes.plot(row["sizes"], row["ms"], "o-", label=label)
    axes.set(xscale="log", yscale="log", title=f"How does time grow with {grows}?")
    axes.set(xlabel=f"{grows}, 1 thread", ylabel=_TIME)
    axes.xaxis.set_minor_formatter(NullFormatter())
    low, high = axes.dataLim.intervaly
    axes.set_ylim(low / 12, high * 1.5)  # below, room for the legend
    axes.legend(loc="lower right")


def _draw_steps(axes: Axes, rows: Sequence[Row]) -> None:
    names = [f"{row['view']}, {row['threads']} thread{'s'[: row['threads'] - 1]}" for row in rows]
    left = np.zeros(len(rows))
    for part in STEP_PARTS:
        ms = np.array([row[f"{part}_ms"] for row in rows])
        axes.barh(names, ms, left=left, label=part)
        left += ms
    axes.invert_yaxis()
    axes.margins(x=_ROOM)
    axes.set(title="What does a training step take?")
    axes.set_xlabel(f"ms\n{rows[0]['gaussians']:,} Gaussians, HR {_size(rows[0])}")
    axes.legend(loc="lower right")


def _describe(row: Row) -> str:
    return f"{row['gaussians']:,} Gaussians, 1 thread"


def _size(row: Row) -> str:
    return f"{row['width']}x{row['height']}"
