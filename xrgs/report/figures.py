"""Draws the figures of a report: renders side by side, curves, number of Gaussians against quality.

Each function returns the bytes of a PNG. The same inputs give the same bytes: matplotlib's default
style replaces the user's, and no date or version is written. pyplot is not used, since it keeps
figures in memory.
"""

from __future__ import annotations

import io
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import NamedTuple

import numpy as np
import pandas as pd
from matplotlib import style
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle
from matplotlib.ticker import EngFormatter, LogLocator, NullLocator
from numpy.typing import NDArray

from xrgs.evaluation.metrics import Metric
from xrgs.photos.images import SOFTWARE
from xrgs.report.writing import named
from xrgs.safeio.sanitize import MAX_CELL, for_line

Image = NDArray[np.float32]

#: Okabe and Ito's orange and blue, which colour-blind readers can distinguish, also in grey.
_ABLATION, _BASELINE, _FRAME = "#D55E00", "#0072B2", "#FFD400"
#: Colour and mark of the baseline, then of up to seven ablations: Okabe and Ito's colours without
#: yellow, which is faint on white.
_ARMS = (
    (_BASELINE, "o"),
    (_ABLATION, "s"),
    ("#009E73", "^"),
    ("#CC79A7", "D"),
    ("#E69F00", "v"),
    ("#56B4E9", "P"),
    ("#000000", "X"),
    ("#777777", "*"),
)
MAX_ARMS = len(_ARMS)
"""The most labels in one figure of curves."""
_DPI = 130
_PANEL = 3.4  # inches
_ZOOM = 5
#: An axis is logarithmic if its largest value is at least this many times the smallest.
_LOG_FROM = 4
#: The longest name beside a figure's axes, in characters; longer ones leave the axes no room.
_MAX_NAME = 40


class Panel(NamedTuple):
    """An image of a figure, with its title and the line under it."""

    image: Image  # [H, W, 3] 0..1
    title: str
    caption: str


@contextmanager
def _default_style() -> Iterator[None]:
    """Use matplotlib's default style, without mathematics between dollar signs.

    Warnings about characters that the font lacks or can't shape are hidden: the report's tables
    have the names.
    """
    with style.context(["default", {"text.parse_math": False}]), warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Glyph .* missing from")
        warnings.filterwarnings("ignore", message="Matplotlib currently does not support")
        yield


def differing_crop(first: Image, second: Image, zoom: int = _ZOOM) -> tuple[slice, slice]:
    """Find the window, `zoom` times smaller than two images [H, W, 3], in which they differ most.

    Return its rows and columns; of equally different windows, the topmost, then the leftmost.
    """
    difference = np.abs(first.astype(np.float64) - second).mean(axis=2)  # [H, W]
    height, width = (max(1, side // zoom) for side in difference.shape)
    sums = np.pad(difference, ((1, 0), (1, 0))).cumsum(0).cumsum(1)  # [H + 1, W + 1]
    boxes = (
        sums[height:, width:] - sums[:-height, width:] - sums[height:, :-width]
        + sums[:-height, :-width]
    )  # fmt: skip
    top, left = np.unravel_index(int(np.argmax(boxes.round(9))), boxes.shape)
    return slice(int(top), int(top) + height), slice(int(left), int(left) + width)


@_default_style()
def side_by_side(
    title: str, panels: Sequence[Panel], crop: tuple[slice, slice], note: str
) -> bytes:
    """Draw panels of one size in a row, with a crop framed, and enlarged below.

    `crop` has its rows and columns, and `note` says how it was chosen.
    """
    rows, columns = crop
    height, width = panels[0].image.shape[:2]
    cut_ratio = (rows.stop - rows.start) / (columns.stop - columns.start)
    ratios = [height / width, cut_ratio]
    figure = _figure(title, _PANEL * len(panels), _PANEL * sum(ratios) + 1.1)
    figure.supxlabel(
        for_line(f"framed, and enlarged in the second row: {note}", MAX_CELL), fontsize=9
    )
    axes = figure.subplots(2, len(panels), height_ratios=ratios)
    corner = (columns.start - 0.5, rows.start - 0.5)
    size = (columns.stop - columns.start, rows.stop - rows.start)
    for (upper, lower), panel in zip(axes.T, panels, strict=True):
        _show(upper, panel.image, "antialiased")
        upper.add_patch(Rectangle(corner, *size, fill=False, edgecolor=_FRAME, linewidth=1.5))
        upper.set_title(for_line(panel.title, _MAX_NAME), fontsize=10)
        upper.set_xlabel(for_line(panel.caption, _MAX_NAME), fontsize=9)
        _show(lower, panel.image[rows, columns], "nearest")
        for spine in lower.spines.values():
            spine.set(edgecolor=_FRAME, linewidth=1.5)
    return png(figure)


@_default_style()
def curves(
    title: str, runs: Sequence[tuple[str, pd.DataFrame]], columns: Mapping[str, str]
) -> bytes:
    """Draw histories over `step`: a panel for each of `columns` (-> its title).

    A line of it is a run; the runs are the baseline's label and history, then the ablation's.
    """
    figure = _figure(title, _PANEL * 1.5 * len(columns), _PANEL)
    axes = figure.subplots(1, len(columns), squeeze=False)[0]
    styles = ({"color": _BASELINE}, {"color": _ABLATION, "linestyle": "--"})
    for axis, (column, name) in zip(axes, columns.items(), strict=True):
        lines = [
            axis.plot(history["step"], history[column], linewidth=1.2, **look)[0]
            for (_, history), look in zip(runs, styles, strict=True)
        ]
        axis.set_xlabel("step")
        axis.set_title(name, fontsize=10)
        _with_grid(axis)
    names = [for_line(label, _MAX_NAME) for label, _ in runs]
    legend = axes[0].legend(lines, names, frameon=False, fontsize=9)
    legend.set_in_layout(False)  # a long name lies over the curves, and takes none of their room
    return png(figure)


@_default_style()
def quality_curves(
    title: str, scenes: pd.DataFrame, means: pd.DataFrame, axes: Sequence[Metric]
) -> bytes:
    """Draw quality during training against time and against alpha evaluations; better is up.

    Each label has a colour: a thick line with marks is its mean over scenes, thin lines are its
    scenes. Horizontal lines are the baseline's final quality. `scenes` has `label` (at most
    `MAX_ARMS`, the baseline first), `scene`, `seconds`, `evaluations` and the scores of each
    evaluation; `means` has the same without `scene`.
    """
    figure = _figure(title, _PANEL * 3 + 2.2, _PANEL * len(axes) + 0.6)
    panels = figure.subplots(len(axes), 2, squeeze=False, sharey="row", sharex="col")
    lines: dict[str, Line2D] = {}
    for row, metric in zip(panels, axes, strict=True):
        for panel, amount in zip(row, ("seconds", "evaluations"), strict=True):
            lines |= _quality_panel(panel, scenes, means, amount, metric.name)
        row[0].set_ylabel(f"{metric.label}{metric.unit and f', {metric.unit}'}")
        _leave_out_the_start(row[0], scenes, metric)
    for panel, name in zip(panels[-1], ("training time, s", "alpha evaluations"), strict=True):
        panel.set_xlabel(name)
        panel.set_xlim(left=0)
    panels[-1][1].xaxis.set_major_formatter(EngFormatter(sep=" "))
    names = [for_line(label, _MAX_NAME) for label in lines]
    figure.legend(lines.values(), names, loc="outside right center", frameon=False, fontsize=9)
    return png(figure)


def _quality_panel(
    axis: Axes, scenes: pd.DataFrame, means: pd.DataFrame, amount: str, quality: str
) -> dict[str, Line2D]:
    """Draw one panel of curves; return the mean line of each label."""
    labels = list(dict.fromkeys(scenes["label"]))
    for label, (color, _) in zip(labels, _ARMS, strict=False):
        for _, curve in scenes[scenes["label"] == label].groupby("scene"):
            axis.plot(curve[amount], curve[quality], color=color, linewidth=0.7, alpha=0.45)
            if label == labels[0]:
                end = curve[quality].iloc[-1]
                axis.axhline(end, color=color, linewidth=0.6, linestyle=":", alpha=0.6)
    lines = {}
    for label, (color, mark) in zip(labels, _ARMS, strict=False):
        curve = means[means["label"] == label]
        (lines[label],) = axis.plot(curve[amount], curve[quality], color=color, linewidth=1.8)
        # A few marks, at different evaluations for each label.
        every = max(1, len(curve) // 6)
        lines[label].set(marker=mark, markersize=5, markevery=(len(lines) % every, every))
        if label == labels[0] and len(curve):
            axis.axhline(curve[quality].iloc[-1], color=color, linewidth=1.3, linestyle="--")
    _with_grid(axis)
    return lines


def _leave_out_the_start(axis: Axes, scenes: pd.DataFrame, metric: Metric) -> None:
    """Scale the quality axis to the last three quarters of the curves, with better up."""
    curves = scenes.groupby(["label", "scene"])[metric.name]
    later = scenes.loc[curves.cumcount() >= curves.transform("size") // 4, metric.name]
    worst, best = later[np.isfinite(later)].agg(["min", "max"])
    if worst < best:
        margin = 0.05 * (best - worst)
        axis.set_ylim(worst - margin, best + margin)
    if not metric.higher_is_better:
        axis.invert_yaxis()


@_default_style()
def trade_off(
    title: str, means: pd.DataFrame, scenes: pd.DataFrame, axes: Sequence[Metric]
) -> bytes:
    """Draw quality against the number of Gaussians, a dot for each label; better is up and left.

    A numbered dot is a label's mean over scenes. Thin lines lead from the baseline to the ablations
    in each scene, and blue lines cross at the baseline's mean. `means` and `scenes` are indexed by
    label, the baseline first, with `gaussians` and the scores; `means` has the number of `scenes`,
    and `scenes` the name of each `scene`.
    """
    figure = _figure(title, _PANEL * 1.1 * len(axes) + 2, max(_PANEL, 0.2 * len(means)))
    panels = figure.subplots(1, len(axes), squeeze=False)[0]
    for panel, metric in zip(panels, axes, strict=True):
        _dots(panel, means, scenes, metric.name)
        panel.set_xlabel("Gaussians")
        panel.set_title(f"{metric.label}{metric.unit and f', {metric.unit}'}", fontsize=10)
        if not metric.higher_is_better:
            panel.invert_yaxis()
    most = int(means["scenes"].max())
    names = "\n".join(
        f"{at} {for_line(str(label), _MAX_NAME)}" + f" ({n} of {most} scenes)" * bool(n < most)
        for at, (label, n) in enumerate(means["scenes"].items())
    )
    panels[-1].annotate(names, (1.04, 1), xycoords="axes fraction", va="top", fontsize=8)
    return png(figure)


def _dots(axis: Axes, means: pd.DataFrame, scenes: pd.DataFrame, quality: str) -> None:
    """Draw one panel of a trade-off."""
    baseline = means.index[0]
    colors = (
        [color for color, _ in _ARMS]
        if len(means) <= MAX_ARMS
        else [_BASELINE, *[_ABLATION] * len(means)]
    )
    start = scenes.loc[[baseline]].set_index("scene")
    for label, color in zip(means.index, colors, strict=False):
        for _, row in scenes.loc[[label]].iterrows():
            spot, base = (at[["gaussians", quality]] for at in (row, start.loc[row["scene"]]))
            axis.plot(*zip(base, spot, strict=True), color=color, linewidth=0.7, alpha=0.45)
            axis.plot(*spot, color=color, marker=".", markersize=4, alpha=0.6)
    for at, (spot, color) in enumerate(
        zip(means[["gaussians", quality]].to_numpy(), colors, strict=False)
    ):
        axis.plot(*spot, color=color, marker="o", markersize=10.5, zorder=3)
        axis.annotate(
            str(at), tuple(spot), ha="center", va="center", color="white", fontsize=7, zorder=4
        )
    axis.axhline(means[quality].iloc[0], color=_BASELINE, linewidth=0.8)
    axis.axvline(means["gaussians"].iloc[0], color=_BASELINE, linewidth=0.8)
    axis.set_xscale("log")
    axis.xaxis.set_major_locator(LogLocator(subs=(1, 2, 3, 5, 7)))
    axis.xaxis.set_minor_locator(NullLocator())
    axis.xaxis.set_major_formatter(EngFormatter(sep=" "))
    _with_grid(axis)


@_default_style()
def dependence(title: str, key: str, changes: pd.DataFrame, axes: Sequence[Metric]) -> bytes:
    """Draw how changes depend on a setting; better is up, and the dashed line is the base.

    Each series has a colour: a thick line with marks is its mean over scenes, thin lines are its
    scenes, and dots are its pairs. `changes` is the key's entry in `pictures.sensitivities`, of at
    most `MAX_ARMS - 1` series.
    """
    figure = _figure(title, _PANEL * len(axes), _PANEL + 0.6)
    panels = figure.subplots(1, len(axes), squeeze=False)[0]
    series = list(dict.fromkeys(changes["series"]))
    for panel, metric in zip(panels, axes, strict=True):
        rows = changes[changes["metric"] == metric.name]
        lines = [
            _dependence_line(panel, rows[rows["series"] == name], look)
            for name, look in zip(series, _ARMS[1:], strict=False)
        ]
        values = sorted(rows["value"].unique())
        if values[0] > 0 and values[-1] >= _LOG_FROM * values[0]:
            panel.set_xscale("log")
            panel.xaxis.set_minor_locator(NullLocator())
        panel.set_xticks(values, [f"{value:g}" for value in values])
        panel.axhline(0, color=_BASELINE, linewidth=1.3, linestyle="--")
        panel.set_title(named(metric), fontsize=10)
        panel.set_xlabel(for_line(key, _MAX_NAME))
        _with_grid(panel)
        if not metric.higher_is_better:
            panel.invert_yaxis()
    if len(series) > 1:
        names = [for_line(name, _MAX_NAME) for name in series]
        figure.legend(lines, names, loc="outside lower center", frameon=False, fontsize=9, ncols=4)
    return png(figure)


def _dependence_line(axis: Axes, rows: pd.DataFrame, look: tuple[str, str]) -> Line2D:
    """Draw one series of a panel; return the line of its mean."""
    color, mark = look
    of = {level: rows[rows["level"] == level] for level in ("pair", "scene", "mean")}
    axis.plot(
        of["pair"]["value"], of["pair"]["change"], color=color, marker=".", linestyle="", alpha=0.45
    )
    for _, curve in of["scene"].groupby("scene"):
        axis.plot(curve["value"], curve["change"], color=color, linewidth=0.7, alpha=0.45)
    mean = of["mean"]
    return axis.plot(mean["value"], mean["change"], color=color, marker=mark, linewidth=1.8)[0]


def _with_grid(axis: Axes) -> None:
    """Give a panel a faint grid, and no frame at the top and on the right."""
    axis.grid(alpha=0.3)
    axis.spines[["top", "right"]].set_visible(False)


def _figure(title: str, width: float, height: float) -> Figure:
    """Make a figure with a title; its size is in inches."""
    figure = Figure(figsize=(width, height), dpi=_DPI, layout="constrained")
    figure.suptitle(for_line(title, MAX_CELL), fontsize=11)
    return figure


def _show(axes: Axes, image: Image, interpolation: str) -> None:
    axes.imshow(np.clip(image, 0, 1), interpolation=interpolation)
    axes.set(xticks=[], yticks=[])


def png(figure: Figure) -> bytes:
    """Return a figure as a PNG at its own resolution; equal figures give equal bytes."""
    stream = io.BytesIO()
    # Not savefig, which gives the same bytes and draws twice: the first time only for the layout.
    FigureCanvasAgg(figure).print_png(stream, metadata={"Software": SOFTWARE})
    return stream.getvalue()
