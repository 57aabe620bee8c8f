"""Chooses what the plot of a benchmark shows: one panel for each question."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from xrgs.bench.growth import Growth, growth_by_gaussians, growth_by_pixels
from xrgs.bench.rendering import TORCH_FLOAT64
from xrgs.report.bench_plot import Level, Line, Mark, Panel, RatioPanel

if TYPE_CHECKING:
    Row = dict[str, Any]

_MIN_ERROR = 1e-9  # an error of 0 has no logarithm
_ERROR = "mean error of the image"
_TIME = "forward + backward, ms"


def panels(results: Row) -> list[Panel | RatioPanel]:
    """Make the panels of the plot, all of them of one thread.

    Args:
        results: All results of the benchmark, with `rows` and `shortcuts`.

    Returns:
        Time against error of each backend, if there are several, and of each cutoff, on the largest
        load that most methods were timed on; what each shortcut saves; and, where loads differ in
        size, how the time grows with Gaussians and with pixels.
    """
    rows = [row for row in results["rows"] if row["threads"] == 1]
    usual = rows[0]["method"]
    load = _largest_common_load(rows)
    made: list[Panel | RatioPanel] = [_backends(load)] if _has_other_backend(load) else []
    made.append(_cutoffs(load, usual))
    made.append(_shortcuts(results["shortcuts"]["renders"]))
    for found, what in (
        (growth_by_gaussians(rows, usual, 1), "Gaussians"),
        (growth_by_pixels(rows, usual, 1), "pixels"),
    ):
        if found:
            made.append(_growth(found, what, results["growth"].get(what.lower())))
    return made


def _largest_common_load(rows: Sequence[Row]) -> list[Row]:
    """Return the rows of the load that most methods were timed on, of several the largest."""
    groups: dict[tuple[str, int, int, int], list[Row]] = {}
    for row in rows:
        key = (row["load"], row["gaussians"], row["width"], row["height"])
        groups.setdefault(key, []).append(row)
    return max(groups.values(), key=lambda group: (len(group), _size(group[0])))


def _has_other_backend(load: Sequence[Row]) -> bool:
    return len({row["backend"] for row in load}) > 1


def _size(row: Row) -> int:
    return int(row["gaussians"] * row["width"] * row["height"])


def _describe(row: Row) -> str:
    return f"{row['gaussians']:,} Gaussians, {row['width']}x{row['height']}, 1 thread"


def _ms(row: Row) -> float:
    return float(row["forward_ms"] + row["backward_ms"])


def _mark(row: Row, label: str) -> Mark:
    return Mark(label, max(row["error"]["image_mean"], _MIN_ERROR), _ms(row))


def _backends(load: Sequence[Row]) -> Panel:
    """Compare the backends at the usual settings; float64 is what errors are measured against."""
    plain = [row for row in load if row["method"] == row["backend"]]
    exact = [row for row in load if row["method"] == TORCH_FLOAT64]
    return Panel(
        title="Which backend?",
        xlabel=f"{_ERROR}\n{_describe(load[0])}",
        ylabel=_TIME,
        marks=tuple(_mark(row, f"{row['backend']} float32") for row in plain),
        levels=tuple(Level(f"{TORCH_FLOAT64}, the reference", _ms(row)) for row in exact),
    )


def _cutoffs(load: Sequence[Row], usual: str) -> Panel:
    """Compare the cutoffs of one backend."""
    prefix = f"{usual}, "
    marks = [_mark(row, "gsplat's settings") for row in load if row["method"] == usual]
    marks += [
        _mark(row, row["method"].removeprefix(prefix))
        for row in load
        if row["method"].startswith(prefix)
    ]
    return Panel(
        title="What do cutoffs cost?",
        xlabel=f"{_ERROR}\n{_describe(load[0])}",
        ylabel=_TIME,
        marks=tuple(marks),
    )


def _shortcuts(rows: Sequence[Row]) -> RatioPanel:
    sizes = list(dict.fromkeys(f"{row['width']}x{row['height']}" for row in rows))
    ratios: dict[str, list[float]] = {}
    for row in rows:
        ratios.setdefault(row["shortcut"], []).append(row["times"])
    return RatioPanel(
        title="What do the shortcuts save?",
        xlabel=f"time without it / with it\n{rows[0]['gaussians']:,} Gaussians, 1 thread",
        series=tuple(sizes),
        ratios={name: tuple(values) for name, values in ratios.items()},
    )


def _growth(found: Sequence[Growth], what: str, together: float | None) -> Panel:
    unit, power = ("", "N") if what == "Gaussians" else (" Gaussians", "pixels")
    return Panel(
        title=f"How does time grow with {what}?",
        xlabel=("Gaussians (N)" if unit == "" else "pixels") + ", 1 thread",
        ylabel=_TIME,
        lines=tuple(
            Line(f"{one.fixed}{unit}: {power}$^{{{one.exponent:.2f}}}$", one.sizes, one.ms)
            for one in found
        ),
        note="" if together is None else f"fitted to all loads: {power}$^{{{together:.2f}}}$",
    )
