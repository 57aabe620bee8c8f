"""Where a picture's window lies, and that its bytes do not depend on the machine's mood."""

import io

import matplotlib as mpl
import numpy as np
import pandas as pd
import pytest
from PIL import Image

from xrgs.evaluation.metrics import Metric
from xrgs.report.figures import Panel, curves, differing_crop, side_by_side, trade_off
from xrgs.report.pictures import median_view

RNG = np.random.default_rng(0)
PICTURE = RNG.uniform(0, 1, (40, 60, 3)).astype(np.float32)


def picture(png: bytes) -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(png)).convert("RGB"))


def panels() -> list[Panel]:
    return [Panel(PICTURE, name, "PSNR 20.00 dB") for name in ("photograph", "baseline", "$a_b$")]


def test_the_window_lies_where_the_images_differ() -> None:
    other = PICTURE.copy()
    other[25:33, 36:48] = 1 - other[25:33, 36:48]
    assert differing_crop(PICTURE, other) == (slice(25, 33), slice(36, 48))


@pytest.mark.parametrize("corner", [(0, 0), (32, 48)])
def test_the_window_reaches_the_corners(corner: tuple[int, int]) -> None:
    other = PICTURE.copy()
    rows, columns = (slice(at, at + size) for at, size in zip(corner, (8, 12), strict=True))
    other[rows, columns] += 1
    assert differing_crop(PICTURE, other) == (rows, columns)


def test_the_window_of_equal_images_is_the_first() -> None:
    assert differing_crop(PICTURE, PICTURE) == (slice(0, 8), slice(0, 12))


def test_the_window_of_a_tiny_image_is_a_pixel() -> None:
    tiny = PICTURE[:3, :4]
    assert differing_crop(tiny, tiny) == (slice(0, 1), slice(0, 1))


def test_the_same_images_give_the_same_bytes_in_any_style() -> None:
    crop = differing_crop(PICTURE, 1 - PICTURE)
    first = side_by_side("部屋 $x$", panels(), crop, "note")
    with mpl.rc_context({"font.size": 20, "axes.facecolor": "red", "savefig.dpi": 30}):
        assert side_by_side("部屋 $x$", panels(), crop, "note") == first
    assert b"Software" not in first


def test_every_panel_shows_its_image() -> None:
    colours = {"a": (1, 0, 0), "b": (0, 1, 0), "c": (0, 0, 1)}
    flat = [Panel(np.full((20, 30, 3), c, np.float32), n, "") for n, c in colours.items()]
    shown = picture(side_by_side("t", flat, (slice(0, 4), slice(0, 6)), "n"))
    thirds = np.array_split(shown, 3, axis=1)
    for third, colour in zip(thirds, colours.values(), strict=True):
        same = (third == np.multiply(colour, 255)).all(axis=2)
        assert same.mean() > 0.5


def test_curves_are_drawn_for_both_runs() -> None:
    history = pd.DataFrame({"step": [0, 1, 2], "loss": [3.0, 2.0, 1.0]})
    runs = [("baseline", history), ("_odd $", history.assign(loss=[1.0, 1.5, 3.0]))]
    png = curves("t", runs, {"loss": "loss"})
    assert png == curves("t", runs, {"loss": "loss"})
    shown = picture(png)
    for colour in ((0x00, 0x72, 0xB2), (0xD5, 0x5E, 0x00)):
        assert (shown == colour).all(axis=2).sum() > 100


ORANGE, BLUE = (0xD5, 0x5E, 0x00), (0x00, 0x72, 0xB2)


@pytest.mark.parametrize("higher_is_better", [True, False])
@pytest.mark.parametrize("better", [True, False])
def test_a_trade_off_has_the_better_up_and_the_smaller_left(
    higher_is_better: bool, better: bool
) -> None:
    quality = Metric("q", "quality", "dB", higher_is_better=higher_is_better)
    change = 2.0 if better == higher_is_better else -2.0
    means = pd.DataFrame({"gaussians": [0.5], "q": [change]}, index=["_odd $"])
    scenes = pd.DataFrame({"gaussians": [0.4, 0.6], "q": [0.0, 2 * change]}, index=["_odd $"] * 2)
    png = trade_off("t", means, scenes, [quality])
    assert png == trade_off("t", means, scenes, [quality])
    shown = picture(png)
    dot = np.argwhere((shown == ORANGE).all(axis=2)).mean(axis=0)
    lines = np.argwhere((shown == BLUE).all(axis=2))
    crossing = [np.bincount(lines[:, axis]).argmax() for axis in (0, 1)]
    assert (dot[0] < crossing[0]) == better
    assert dot[1] < crossing[1]


def test_the_view_shown_is_neither_the_best_nor_the_worst() -> None:
    baseline = pd.Series({"a": 20.0, "b": 20.0, "c": 20.0})
    assert median_view(baseline, pd.Series({"a": 25.0, "b": 10.0, "c": 21.0})) == "c"
    assert median_view(baseline, baseline) == "b"
    assert median_view(baseline * np.inf, baseline * np.inf) == "b"
