"""The plot of a benchmark: every label is there, inside the figure, and covers no other."""

from __future__ import annotations

from itertools import combinations

import pytest
from matplotlib.figure import Figure
from matplotlib.text import Text
from matplotlib.transforms import Bbox

from xrgs.report.bench_plot import Level, Line, Mark, Panel, RatioPanel, draw_panels, panel_figure

MARKS = (
    Mark("native float32", 1e-7, 35.0),
    Mark("torch float32", 1.02e-7, 36.0),  # nearly the same place
    Mark("alpha cut 4/255", 7e-3, 30.0),
    Mark("stop at 1e-2", 6.5e-3, 33.0),
)
LINES = tuple(
    Line(f"{name}: N$^{{0.5}}$", (1e4, 1e5, 1e6), (1.0, 10.0, end))
    for name, end in (("252x189", 100.0), ("504x378", 101.0), ("1008x756", 103.0))
)
PANELS = (
    Panel("Marks", "error", "ms", marks=MARKS),
    Panel("Levels", "error", "ms", marks=MARKS[:1], levels=(Level("torch float64", 900.0),)),
    RatioPanel("Ratios", "times", ("HR", "LR"), {"tiles": (1.0, 1.0), "blocks": (2.1, 2.3)}),
    Panel("Lines", "N", "ms", lines=LINES, note="fitted to all loads"),
    Panel("One line", "N", "ms", lines=LINES[:1]),
)


@pytest.fixture(scope="module")
def figure() -> Figure:
    return panel_figure(PANELS)


def test_every_label_is_written_once(figure: Figure) -> None:
    written = [[text.get_text() for text in axes.texts] for axes in figure.axes]
    assert sorted(written[0]) == sorted(mark.label for mark in MARKS)
    assert sorted(written[1]) == ["native float32", "torch float64"]
    assert sorted(written[2]) == ["1.00", "1.00", "2.10  HR", "2.30  LR"]
    assert sorted(written[3]) == sorted([*(line.label for line in LINES), "fitted to all loads"])
    assert [axes.get_title(loc="left") for axes in figure.axes] == [one.title for one in PANELS]


@pytest.mark.parametrize("panel", range(len(PANELS)))
def test_labels_overlap_neither_each_other_nor_marks(figure: Figure, panel: int) -> None:
    axes = figure.axes[panel]
    boxes = {
        text.get_text() + str(at): text.get_window_extent() for at, text in enumerate(axes.texts)
    }
    for (name, box), (other, second) in combinations(boxes.items(), 2):
        assert not box.overlaps(second), (name, other)
    for line in axes.lines:
        if line.get_marker() == "None":
            continue
        radius = 0.5 * line.get_markersize() * figure.dpi / 72 - 1
        for x, y in axes.transData.transform(line.get_xydata()):
            mark = Bbox.from_extents(x - radius, y - radius, x + radius, y + radius)
            assert not [name for name, box in boxes.items() if box.overlaps(mark)]


@pytest.mark.parametrize("panel", range(len(PANELS)))
def test_labels_lie_in_their_panel(figure: Figure, panel: int) -> None:
    axes = figure.axes[panel]
    for text in axes.texts:
        box = text.get_window_extent()
        assert axes.bbox.x0 <= box.x0, text
        assert box.x1 <= axes.bbox.x1, text
        assert axes.bbox.y0 <= box.y0, text
        assert box.y1 <= axes.bbox.y1, text


def test_titles_and_axis_labels_of_neighbours_do_not_overlap(figure: Figure) -> None:
    titles = {panel.title for panel in PANELS}
    texts = figure.findobj(lambda one: isinstance(one, Text) and one.get_text() in titles)
    texts += [axes.xaxis.label for axes in figure.axes]
    boxes = [text.get_window_extent() for text in texts]
    assert len(boxes) == 2 * len(PANELS)
    assert not [1 for one, other in combinations(boxes, 2) if one.overlaps(other)]
    assert all(box.x0 >= 0 and box.x1 <= figure.bbox.x1 for box in boxes)


def test_the_axes_are_logarithmic(figure: Figure) -> None:
    assert {axes.get_xscale() for axes in figure.axes} == {"log"}
    assert [axes.get_yscale() for axes in figure.axes] == ["log", "log", "linear", "log", "log"]


def test_a_plot_is_a_png_and_the_same_each_time() -> None:
    drawn = draw_panels(PANELS[:1])
    assert drawn.startswith(b"\x89PNG")
    assert drawn == draw_panels(PANELS[:1])
