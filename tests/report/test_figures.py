"""Where a picture's window lies, and that its bytes do not depend on the machine's mood."""

import io

import matplotlib as mpl
import numpy as np
import pandas as pd
import pytest
from PIL import Image

from xrgs.evaluation.metrics import Metric
from xrgs.report.figures import (
    Panel,
    curves,
    dependence,
    differing_crop,
    quality_curves,
    side_by_side,
    trade_off,
)
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
    rows, columns = slice(0, 8), slice(48, 60)
    other = PICTURE.copy()
    other[rows, columns] += 1
    assert differing_crop(PICTURE, other) == (rows, columns), "it reaches the corners"
    assert differing_crop(PICTURE, PICTURE) == (slice(0, 8), slice(0, 12)), "the first"
    tiny = PICTURE[:3, :4]
    assert differing_crop(tiny, tiny) == (slice(0, 1), slice(0, 1)), "a pixel"


@pytest.mark.slow
def test_the_same_images_give_the_same_bytes_in_any_style() -> None:
    crop = differing_crop(PICTURE, 1 - PICTURE)
    first = side_by_side("部屋 $x$", panels(), crop, "note")
    with mpl.rc_context({"font.size": 20, "axes.facecolor": "red", "savefig.dpi": 30}):
        assert side_by_side("部屋 $x$", panels(), crop, "note") == first
    assert b"Software\0xrgs" in first
    assert b"Matplotlib" not in first  # its version would be other bytes


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


def traded(name: str, gaussians: list[float], quality: list[float]) -> tuple[pd.DataFrame, ...]:
    """Means and scenes of the baseline and of an ablation, two scenes each."""
    labels = ["baseline"] * 2 + [name] * 2
    scenes = pd.DataFrame({"gaussians": gaussians, "q": quality}, index=labels)
    means = scenes.groupby(level=0, sort=False).mean().assign(scenes=2)
    return means, scenes.assign(scene=["fern", "horns"] * 2)


@pytest.mark.slow
@pytest.mark.parametrize(("higher_is_better", "better"), [(True, True), (False, False)])
def test_a_trade_off_has_the_better_up_and_the_smaller_left(
    higher_is_better: bool, better: bool
) -> None:
    quality = Metric("q", "quality", "dB", higher_is_better=higher_is_better)
    change = 2.0 if better == higher_is_better else -2.0
    means, scenes = traded(
        "_odd $", [9e4, 11e4, 5e4, 6e4], [20.0, 24.0, 20.0 + change, 24.0 + 1.5 * change]
    )
    shown = picture(trade_off("t", means, scenes, [quality]))
    dot = np.argwhere((shown == ORANGE).all(axis=2)).mean(axis=0)
    lines = np.argwhere((shown == BLUE).all(axis=2))
    crossing = [np.bincount(lines[:, axis]).argmax() for axis in (0, 1)]
    assert (dot[0] < crossing[0]) == better
    assert dot[1] < crossing[1]


def changes_over(values: list[float], changes: list[float], series: str = "") -> pd.DataFrame:
    rows = pd.DataFrame({"value": values, "change": changes, "series": series, "metric": "q"})
    levels = [("pair", "fern"), ("scene", "fern"), ("mean", None)]
    return pd.concat(rows.assign(level=level, scene=scene) for level, scene in levels)


@pytest.mark.parametrize(("higher_is_better", "better"), [(True, True), (False, False)])
def test_a_better_change_over_a_setting_is_above_the_line_of_the_base(
    higher_is_better: bool, better: bool
) -> None:
    quality = Metric("q", "quality", "", higher_is_better=higher_is_better)
    sign = 1.0 if better == higher_is_better else -1.0
    changes = changes_over([0.1, 0.5, 1.0], [sign * 2, sign * 3, sign * 2.5])
    shown = picture(dependence("$t_", "a_$b", changes, [quality]))
    curve = np.argwhere((shown == ORANGE).all(axis=2))[:, 0].mean()
    base = np.bincount(np.argwhere((shown == BLUE).all(axis=2))[:, 0]).argmax()
    assert (curve < base) == better


METRICS = [
    Metric("psnr", "PSNR", "dB", higher_is_better=True),
    Metric("lpips", "LPIPS", "", higher_is_better=False),
]


def trained(label: str, scene: str, psnr: list[float]) -> pd.DataFrame:
    amount = np.arange(1.0, len(psnr) + 1)
    return pd.DataFrame(
        {"label": label, "scene": scene, "seconds": amount, "evaluations": 1e9 * amount}
        | {"psnr": psnr, "lpips": [1 - value / 40 for value in psnr]}
    )


@pytest.mark.slow
def test_quality_curves_have_a_level_where_the_baseline_ends() -> None:
    scenes = pd.concat(
        [trained("baseline", "fern", [10, 16, 20]), trained("_odd $", "fern", [14, 22, 26])]
    )
    shown = picture(quality_curves("t", scenes, scenes.drop(columns="scene"), METRICS))
    panels = [half for part in np.array_split(shown, 2) for half in np.array_split(part, 2, axis=1)]
    for panel in panels[0], panels[2]:  # against time: PSNR, and LPIPS, which is inverted
        blue = (panel == BLUE).all(axis=2)
        orange = np.argwhere((panel == ORANGE).all(axis=2))
        level = np.bincount(np.argwhere(blue)[:, 0]).argmax()
        assert blue[level].sum() > panel.shape[1] / 3
        assert orange[:, 0].min() < level - 20, "the ablation ends above it"
        assert orange[:, 0].max() > level + 20, "and begins below it"


def test_the_view_shown_is_neither_the_best_nor_the_worst() -> None:
    baseline = pd.Series({"a": 20.0, "b": 20.0, "c": 20.0})
    assert median_view(baseline, pd.Series({"a": 25.0, "b": 10.0, "c": 21.0})) == "c"
    assert median_view(baseline, baseline) == "b"
    assert median_view(baseline * np.inf, baseline * np.inf) == "b"


@pytest.mark.slow
def test_any_name_is_drawn_without_a_warning() -> None:
    """Mathematics, scripts that the font lacks, codes of a terminal, half a character; a long one.

    What is cut off is the end.
    """
    name = "a\nb\x1b[2J\ud800 " + r"$\frac{1}{$ \no" + " कम བོད " + "部" * 60 + "x" * 10**6
    history = pd.DataFrame({"step": [0, 1], "loss": [1.0, 0.5], "gaussians": [1, 2]})
    means, scenes = traded(name, [1e5, 2e5, 1e5, 3e5], [20.0, 21.0, 22.0, 23.0])
    metric = Metric("q", "PSNR", "dB", higher_is_better=True)
    runs = pd.concat([trained("baseline", name, [1, 2]), trained(name, name, [2, 3])])
    crop = differing_crop(PICTURE, 1 - PICTURE)
    for png in (
        side_by_side(name, [Panel(PICTURE, name, name)] * 3, crop, name),
        curves(name, [(name, history), (name, history)], {"loss": "loss", "gaussians": "x"}),
        trade_off(name, means, scenes, [metric]),
        quality_curves(name, runs, runs.drop(columns="scene"), METRICS),
    ):
        assert picture(png).std() > 0
