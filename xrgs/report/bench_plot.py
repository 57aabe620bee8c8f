"""The plot of a benchmark: one panel for each question, with its labels beside what they name."""

from __future__ import annotations

import io
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from matplotlib import style
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter
from matplotlib.transforms import Bbox

if TYPE_CHECKING:
    from collections.abc import Sequence

    from matplotlib.axes import Axes
    from matplotlib.text import Annotation, Text

_DPI = 150
_PANELS_PER_ROW = 3
_SIZE = (13.0, 4.2)  # of a row of panels, inches
_PADDING = 0.13  # between panels, inches
_FONT = 11
_MARK = 9  # diameter of a mark, points
#: Okabe and Ito's colours, told apart by colour-blind readers.
_COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00")
_LEVEL_COLOR = "#555555"
#: Where a label may stand beside its mark, the best first: offset in points and alignment.
_PLACES = (
    (9, 0, "left", "center"),
    (-9, 0, "right", "center"),
    (0, 9, "center", "bottom"),
    (0, -9, "center", "top"),
    (6, 8, "left", "bottom"),
    (6, -8, "left", "top"),
    (-6, 8, "right", "bottom"),
    (-6, -8, "right", "top"),
    (9, 18, "left", "bottom"),
    (9, -18, "left", "top"),
    (-9, 18, "right", "bottom"),
    (-9, -18, "right", "top"),
    (0, 26, "center", "bottom"),
    (0, -26, "center", "top"),
)
_LINE_GAP = 2  # between the labels at the ends of lines, px


@dataclass(frozen=True)
class Mark:
    """A labelled point."""

    label: str
    x: float
    y: float


@dataclass(frozen=True)
class Level:
    """A labelled horizontal line: a time that has no error."""

    label: str
    y: float


@dataclass(frozen=True)
class Line:
    """A line of points, labelled at its end."""

    label: str
    x: tuple[float, ...]
    y: tuple[float, ...]


@dataclass(frozen=True)
class Panel:
    """A question, answered by points, levels or lines on two logarithmic axes."""

    title: str
    xlabel: str
    ylabel: str
    marks: tuple[Mark, ...] = ()
    levels: tuple[Level, ...] = ()
    lines: tuple[Line, ...] = ()
    note: str = ""
    """Printed in the upper left corner."""


@dataclass(frozen=True)
class RatioPanel:
    """A question, answered by a row of ratios for each name, on a logarithmic axis."""

    title: str
    xlabel: str
    series: tuple[str, ...]
    ratios: dict[str, tuple[float, ...]]
    """For each name, the ratio of each series."""


def draw_panels(panels: Sequence[Panel | RatioPanel]) -> bytes:
    """Draw the panels of a benchmark.

    Args:
        panels: The panels, row by row.

    Returns:
        The bytes of a PNG.
    """
    figure = panel_figure(panels)
    stream = io.BytesIO()
    figure.savefig(stream, format="png", dpi=_DPI, metadata={"Software": None})
    return stream.getvalue()


def panel_figure(panels: Sequence[Panel | RatioPanel]) -> Figure:
    """Make the figure that `draw_panels` draws.

    Args:
        panels: The panels, row by row.

    Returns:
        The figure, with an axes for each panel in their order, and all labels in place.
    """
    rows = [panels[at : at + _PANELS_PER_ROW] for at in range(0, len(panels), _PANELS_PER_ROW)]
    with style.context("default"):
        layout = ConstrainedLayoutEngine(w_pad=_PADDING, h_pad=_PADDING)
        figure = Figure(figsize=(_SIZE[0], _SIZE[1] * len(rows)), dpi=_DPI, layout=layout)
        canvas = FigureCanvasAgg(figure)
        grid = figure.add_gridspec(len(rows), _PANELS_PER_ROW * 2)
        drawn: list[tuple[Axes, Panel | RatioPanel]] = []
        for number, row in enumerate(rows):
            width = _PANELS_PER_ROW * 2 // len(row)  # of a panel, so that each row is full
            for column, panel in enumerate(row):
                place = grid[number, column * width : (column + 1) * width]
                axes = figure.add_subplot(place)
                _draw(axes, panel)
                drawn.append((axes, panel))
        canvas.draw()  # the layout decides where the axes are
        figure.set_layout_engine("none")
        for axes, panel in drawn:
            _label(axes, panel)
    return figure


def _draw(axes: Axes, panel: Panel | RatioPanel) -> None:
    axes.set_title(panel.title, fontsize=_FONT + 1, loc="left", fontweight="bold")
    axes.set_xlabel(panel.xlabel, fontsize=_FONT)
    axes.tick_params(labelsize=_FONT - 1)
    axes.spines[["top", "right"]].set_visible(False)
    if isinstance(panel, RatioPanel):
        _draw_ratios(axes, panel)
        return
    axes.set(xscale="log", yscale="log")
    axes.set_ylabel(panel.ylabel, fontsize=_FONT)
    axes.grid(visible=True, which="major", alpha=0.25)
    for index, mark in enumerate(panel.marks):
        axes.plot(mark.x, mark.y, "o", color=_color(index), markersize=_MARK)
    for level in panel.levels:
        axes.axhline(level.y, color=_LEVEL_COLOR, linestyle="--", linewidth=1.5)
    for index, line in enumerate(panel.lines):
        axes.plot(line.x, line.y, "o-", color=_color(index), markersize=_MARK * 0.6)
    if panel.marks:
        _show_decades(axes, [mark.x for mark in panel.marks])
    ys = [mark.y for mark in panel.marks] + [level.y for level in panel.levels]
    ys += [y for line in panel.lines for y in line.y]
    low, high = min(ys), max(ys)
    spread = max(high / low, 4.0) ** 0.25
    # Above, room for the note.
    axes.set_ylim(low / spread, high * spread ** (1.6 if panel.note else 1.0))
    _plain_ticks(axes, axis="y", decades=high / low > 100)


def _color(index: int) -> str:
    return _COLORS[index % len(_COLORS)]


def _show_decades(axes: Axes, xs: Sequence[float]) -> None:
    """Show the data and a little more than a decade on both sides, with a tick for each decade."""
    axes.set_xlim(min(xs) / 20, max(xs) * 20)
    axes.xaxis.set_major_locator(LogLocator(10))
    axes.xaxis.set_minor_formatter(NullFormatter())


def _plain_ticks(axes: Axes, *, axis: str, decades: bool) -> None:
    """Write numbers as such, at 1, 2 and 5 of each decade, or at decades only."""
    ticks = getattr(axes, f"{axis}axis")
    ticks.set_major_locator(LogLocator(10, subs=(1.0,) if decades else (1.0, 2.0, 5.0)))
    ticks.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,.4g}"))
    ticks.set_minor_formatter(NullFormatter())


def _draw_ratios(axes: Axes, panel: RatioPanel) -> None:
    names = list(panel.ratios)
    count = len(panel.series)
    for place, name in enumerate(names):
        for index, ratio in enumerate(panel.ratios[name]):
            height = _ratio_height(len(names), place, index, count)
            axes.plot((1.0, ratio), (height, height), color=_color(index), linewidth=2.5)
            axes.plot(ratio, height, "o", color=_color(index), markersize=_MARK * 0.8)
    axes.axvline(1.0, color=_LEVEL_COLOR, linewidth=1.0)
    axes.set_xscale("log")
    values = [ratio for ratios in panel.ratios.values() for ratio in ratios]
    axes.set_xlim(min(0.8, min(values) / 1.1), max(2.0, *values) * 1.9)
    axes.set_ylim(-0.6, len(names) - 0.4)
    axes.set_yticks([len(names) - 1 - place for place in range(len(names))], names)
    axes.grid(visible=True, which="major", axis="x", alpha=0.25)
    axes.tick_params(axis="y", length=0)
    _plain_ticks(axes, axis="x", decades=False)


def _ratio_height(names: int, place: int, index: int, count: int) -> float:
    """Return the height of a ratio: its row, and the series of a row one below the other."""
    return names - 1 - place + 0.5 * (0.5 * (count - 1) - index) / max(count - 1, 1)


def _label(axes: Axes, panel: Panel | RatioPanel) -> None:
    if isinstance(panel, RatioPanel):
        _label_ratios(axes, panel)
        return
    taken = [_mark_box(axes, mark.x, mark.y) for mark in panel.marks]
    for level in panel.levels:
        text = axes.annotate(
            level.label,
            (0.02, level.y),
            xycoords=("axes fraction", "data"),
            xytext=(0, 4),
            textcoords="offset points",
            color=_LEVEL_COLOR,
            fontsize=_FONT,
        )
        taken.append(_box(text))
    for index, mark in enumerate(panel.marks):
        taken.append(_box(_place_label(axes, mark, _color(index), taken)))
    _label_lines(axes, panel.lines)
    if panel.note:
        axes.text(0.02, 0.98, panel.note, transform=axes.transAxes, va="top", fontsize=_FONT)


def _place_label(axes: Axes, mark: Mark, color: str, taken: Sequence[Bbox]) -> Text:
    """Write a mark's label at the first place where it covers nothing, or else at the last."""
    text = axes.annotate(
        mark.label,
        (mark.x, mark.y),
        xytext=(0, 0),
        textcoords="offset points",
        color=color,
        fontsize=_FONT,
    )
    for dx, dy, horizontal, vertical in _PLACES:
        text.set_position((dx, dy))
        text.set(ha=horizontal, va=vertical)
        box = _box(text)
        inside = axes.bbox.x0 <= box.x0 and box.x1 <= axes.bbox.x1
        inside = inside and axes.bbox.y0 <= box.y0 and box.y1 <= axes.bbox.y1
        if inside and not any(box.overlaps(other) for other in taken):
            break
    return text


def _label_lines(axes: Axes, lines: Sequence[Line]) -> None:
    """Write each line's label at its right end; labels that would overlap move up."""
    if not lines:
        return
    _make_room_for_labels(axes, lines)
    bottom = float("-inf")
    by_end = sorted(range(len(lines)), key=lambda index: lines[index].y[-1])
    for index in by_end:
        line = lines[index]
        text = _annotate(axes, line.label, (line.x[-1], line.y[-1]), _color(index))
        rise = max(0.0, bottom + _LINE_GAP - _box(text).y0)
        text.set_position((8, rise * 72 / _DPI))
        bottom = _box(text).y1


def _make_room_for_labels(axes: Axes, lines: Sequence[Line]) -> None:
    """Widen the x axis so that the labels at the ends of the lines lie within it."""
    left, right = min(line.x[0] for line in lines), max(line.x[-1] for line in lines)
    texts = [_annotate(axes, line.label, (line.x[-1], line.y[-1]), _LEVEL_COLOR) for line in lines]
    widest = max(_box(text).width for text in texts) / axes.bbox.width
    for text in texts:
        text.remove()
    # The axis is linear in the logarithm: the lines keep the share that the labels leave.
    margin = 0.03
    extent = (right / left) ** (1 / (1 - widest - 3 * margin))
    axes.set_xlim(left / extent**margin, left * extent ** (1 - margin))


def _label_ratios(axes: Axes, panel: RatioPanel) -> None:
    """Write every ratio beside its mark, and the names of the series beside those of one row."""
    names = list(panel.ratios)
    widest = max(names, key=lambda name: max(panel.ratios[name]))
    for place, name in enumerate(names):
        for index, ratio in enumerate(panel.ratios[name]):
            height = _ratio_height(len(names), place, index, len(panel.series))
            series = f"  {panel.series[index]}" if name == widest else ""
            at = (max(ratio, 1.0), height)
            _annotate(axes, f"{ratio:.2f}{series}", at, _color(index), size=_FONT - 2)


def _annotate(
    axes: Axes, label: str, at: tuple[float, float], color: str, size: int = _FONT
) -> Annotation:
    """Write a label to the right of a point."""
    kwargs: dict[str, Any] = {"ha": "left", "va": "center", "color": color, "fontsize": size}
    return axes.annotate(label, at, xytext=(8, 0), textcoords="offset points", **kwargs)


def _box(text: Text) -> Bbox:
    return text.get_window_extent()


def _mark_box(axes: Axes, x: float, y: float) -> Bbox:
    centre_x, centre_y = axes.transData.transform((x, y))
    half = 0.5 * _MARK * _DPI / 72
    return Bbox.from_extents(centre_x - half, centre_y - half, centre_x + half, centre_y + half)
