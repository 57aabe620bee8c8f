"""Draws a comparison: renders side by side, training curves, number of Gaussians against quality.

The same inputs give the same bytes: matplotlib's own style is used whatever the user's is, and no
date or version is written. pyplot is not used, since it keeps figures in memory.
"""

from __future__ import annotations

import io
import warnings
from contextlib import contextmanager
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from matplotlib import style
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.ticker import StrMethodFormatter

from xrgs.safeio.words import MAX_CELL, for_line

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    import pandas as pd
    from matplotlib.axes import Axes
    from numpy.typing import NDArray

    from xrgs.evaluation.metrics import Metric

    Image = NDArray[np.float32]

#: Okabe and Ito's orange and blue, which colour-blind readers can distinguish, also in grey.
_ABLATION, _BASELINE, _FRAME = "#D55E00", "#0072B2", "#FFD400"
_DPI = 130
_PANEL = 3.4  # inches
_ZOOM = 5
#: The longest name beside a figure's axes, in characters: a longer one would leave them no room.
_MAX_NAME = 50


class Panel(NamedTuple):
    """One image of a row, with its title and the line under it."""

    image: Image  # [H, W, 3] 0..1
    title: str
    caption: str


@contextmanager
def _default_style() -> Iterator[None]:
    """Use matplotlib's own style, in which a name with dollar signs is not read as mathematics.

    Nothing is said of characters that its font lacks, or of scripts that it can't shape: they are
    drawn as boxes, or letter by letter; the tables of the report have the name.
    """
    with style.context(["default", {"text.parse_math": False}]), warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Glyph .* missing from")
        warnings.filterwarnings("ignore", message="Matplotlib currently does not support")
        yield


def differing_crop(first: Image, second: Image, zoom: int = _ZOOM) -> tuple[slice, slice]:
    """Find the window, `zoom` times smaller than the images, in which they differ most.

    Args:
        first: [H, W, 3] in 0..1.
        second: [H, W, 3] in 0..1.
        zoom: How many times smaller the window's sides are than the images'.

    Returns:
        The window's rows and columns; of equal windows, the topmost and then the leftmost.
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
    """Draw the panels in a row with `crop` framed, and each panel's crop enlarged below it.

    Args:
        title: The title of the figure.
        panels: The images, of one size: photograph, baseline and ablation.
        crop: The rows and columns of the crop, as `differing_crop` returns them.
        note: What the crop shows, for example "where the two differ most".

    Returns:
        The bytes of a PNG.
    """
    rows, columns = crop
    height, width = panels[0].image.shape[:2]
    cut_ratio = (rows.stop - rows.start) / (columns.stop - columns.start)
    ratios = [height / width, cut_ratio]
    figure = _figure(_PANEL * len(panels), _PANEL * sum(ratios) + 1.1)
    figure.suptitle(for_line(title, MAX_CELL), fontsize=11)
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
    return _png(figure)


@_default_style()
def curves(
    title: str, runs: Sequence[tuple[str, pd.DataFrame]], columns: Mapping[str, str]
) -> bytes:
    """Draw training curves over steps: one panel for each column, one line for each run.

    Args:
        title: The title of the figure.
        runs: Label and history (with `step` and `columns`) of the baseline, then of the ablation.
        columns: The columns to draw, with the title of each panel.

    Returns:
        The bytes of a PNG.
    """
    figure = _figure(_PANEL * 1.5 * len(columns), _PANEL)
    figure.suptitle(for_line(title, MAX_CELL), fontsize=11)
    axes = figure.subplots(1, len(columns), squeeze=False)[0]
    styles = ({"color": _BASELINE}, {"color": _ABLATION, "linestyle": "--"})
    for axis, (column, name) in zip(axes, columns.items(), strict=True):
        lines = [
            axis.plot(history["step"], history[column], linewidth=1.2, **look)[0]
            for (_, history), look in zip(runs, styles, strict=True)
        ]
        axis.set_xlabel("step")
        axis.set_title(name, fontsize=10)
        axis.grid(alpha=0.3)
        axis.spines[["top", "right"]].set_visible(False)
    names = [for_line(label, _MAX_NAME) for label, _ in runs]
    axes[0].legend(lines, names, frameon=False, fontsize=9)
    return _png(figure)


@_default_style()
def trade_off(
    title: str, means: pd.DataFrame, scenes: pd.DataFrame, axes: Sequence[Metric]
) -> bytes:
    """Draw each ablation by its number of Gaussians and its quality, one panel for each score.

    Better is up and left. A numbered dot is an ablation's mean; thin lines lead to its scenes.

    Args:
        title: The title of the figure.
        means: One row for each label, in order: `gaussians`, as a multiple of the baseline's, above
            0; and for each of `axes`, in a column of its name, its change from the baseline, in its
            unit or, where it has none, in percent.
        scenes: The same columns and index, one row for each label and scene.
        axes: The scores to draw.

    Returns:
        The bytes of a PNG.
    """
    figure = _figure(_PANEL * 1.1 * len(axes) + 2, max(_PANEL, 0.2 * len(means)))
    figure.suptitle(for_line(title, MAX_CELL), fontsize=11)
    panels = figure.subplots(1, len(axes), squeeze=False)[0]
    for panel, metric in zip(panels, axes, strict=True):
        _dots(panel, means, scenes, metric.name)
        panel.set_xlabel("Gaussians, times the baseline's")
        panel.set_title(f"{metric.label}, {metric.unit or '%'}", fontsize=10)
        if not metric.higher_is_better:
            panel.invert_yaxis()
    names = "\n".join(
        f"{at} {for_line(label, _MAX_NAME)}" for at, label in enumerate(means.index, start=1)
    )
    panels[-1].annotate(names, (1.04, 1), xycoords="axes fraction", va="top", fontsize=8)
    return _png(figure)


def _dots(axis: Axes, means: pd.DataFrame, scenes: pd.DataFrame, quality: str) -> None:
    """Draw one panel of a trade-off, with blue lines that cross where the baseline is."""
    for label, row in scenes.iterrows():
        ends = means.loc[[label], ["gaussians", quality]].to_numpy()[0], row[["gaussians", quality]]
        axis.plot(*zip(*ends, strict=True), color="0.75", linewidth=0.7)
    axis.scatter(means["gaussians"], means[quality], s=110, color=_ABLATION, zorder=3)
    for at, spot in enumerate(means[["gaussians", quality]].to_numpy(), start=1):
        axis.annotate(
            str(at), tuple(spot), ha="center", va="center", color="white", fontsize=7, zorder=4
        )
    axis.axhline(0, color=_BASELINE, linewidth=0.8)
    axis.axvline(1, color=_BASELINE, linewidth=0.8)
    axis.set_xscale("log", base=2)
    axis.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axis.grid(alpha=0.3)
    axis.spines[["top", "right"]].set_visible(False)


def _figure(width: float, height: float) -> Figure:
    """Make an empty figure of this size in inches."""
    return Figure(figsize=(width, height), dpi=_DPI, layout="constrained")


def _show(axes: Axes, image: Image, interpolation: str) -> None:
    axes.imshow(np.clip(image, 0, 1), interpolation=interpolation)
    axes.set(xticks=[], yticks=[])


def _png(figure: Figure) -> bytes:
    stream = io.BytesIO()
    figure.savefig(stream, format="png", metadata={"Software": None})
    return stream.getvalue()
