"""A variant's table and contact sheet: true to its views, and clear where there is no variant."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from xrgs.capture.contact_sheet import COLOURS, contact_sheet
from xrgs.capture.views import Variant, View
from xrgs.errors import XrgsError
from xrgs.report import variant as inspect
from xrgs.report.render import to_text

Run = Callable[..., tuple[int, str, str]]


def view(folder: Path, name: str, split: str, tag: str, size: tuple[int, int], rho: float) -> View:
    """Of noise: no two of its pixels are alike."""
    file = folder / split / f"{name}.png"
    file.parent.mkdir(parents=True, exist_ok=True)
    pixels = np.random.default_rng(len(name)).integers(0, 256, (size[1], size[0], 3))
    Image.fromarray(pixels.astype(np.uint8)).save(file)
    return View(name, file, split, tag, *size, np.eye(3), np.eye(4), rho)


@pytest.fixture
def mixed(tmp_path: Path) -> Variant:
    """One HR, one LR and its original, one test."""
    views = (
        view(tmp_path, "b-low", "original", "HR", (400, 300), 1.0),
        view(tmp_path, "c-held-out", "test", "HR", (400, 300), 0.9),
        view(tmp_path, "a", "train", "HR", (400, 300), 1.0),
        view(tmp_path, "b-low", "train", "LR", (80, 60), 0.2),
    )
    report: dict[str, Any] = {"hr": ["a"], "lr": ["b-low", "lost"]}
    nothing = np.zeros((0, 3))
    return Variant(
        "key-hash", tmp_path, "room", 5, True, views, nothing, nothing.astype(np.uint8), report
    )


def tiles(sheet: Image.Image, columns: int = 2) -> list[np.ndarray]:
    """Each view's tile, in order: its border is what is found at the tile's own place."""
    step, top = (468, 228), 32
    return [
        np.asarray(sheet)[top + (i // columns) * step[1] :, 8 + (i % columns) * step[0] :]
        for i in range(3)
    ]


def rgb(colour: str) -> list[int]:
    return [int(colour[i : i + 2], 16) for i in (1, 3, 5)]


@pytest.mark.slow
def test_a_variant_is_built_described_and_drawn(xrgs_data: Run, tmp_path: Path) -> None:
    arguments = ("scene=motorcycle", "preset=smoke", "store=s", "out=sheet.png")
    code, out, err = xrgs_data("inspect", *arguments)
    assert code == 0, err
    for text in ("motorcycle_left", "motorcycle_right", "250 x 165", "50 x 33", "2 of 2 views"):
        assert text in out
    drawn = (tmp_path / "sheet.png").read_bytes()
    folder = next((tmp_path / "s" / "variants").glob("[!.]*"))
    code, again, err = xrgs_data("inspect", str(folder.relative_to(tmp_path)), "out=sheet.png")
    assert code == 0, err
    assert again == out
    assert (tmp_path / "sheet.png").read_bytes() == drawn

    code, out, err = xrgs_data("inspect", *arguments[:-1], "out=no/sheet.png")
    assert code == 1
    assert "out=no/sheet.png: can't be written" in err
    image = next(folder.rglob("motorcycle_left.png"))
    image.write_bytes(image.read_bytes()[:-1])
    code, out, err = xrgs_data("inspect", str(folder))
    assert code == 1
    assert "motorcycle_left.png: it has changed since it was frozen" in err
    (folder / "variant.json").unlink()
    code, out, err = xrgs_data("inspect", str(folder))
    assert code == 1
    assert out == ""
    assert "not a complete variant" in err


def test_the_table_has_a_row_a_view_and_leaves_originals_out(mixed: Variant) -> None:
    report = mixed.report | {"not_registered": ["lost", "gone"]}
    table = inspect.views_table(replace(mixed, report=report))
    assert table.rows == (
        ("a", "train", "HR", "400 x 300", "1.000", "yes"),
        ("b-low", "train", "LR", "80 x 60", "0.200", "yes"),
        ("c-held-out", "test", "HR", "400 x 300", "0.900", "yes"),
        ("gone", "test", "HR", "", "", "no"),
        ("lost", "train", "LR", "", "", "no"),
    )
    text = to_text(table)
    assert "1 HR and 1 LR to train on, 1 held out" in text
    assert "originals of degraded views kept beside them: 1" in text


def test_a_failed_variant_says_what_was_tried(tmp_path: Path) -> None:
    folder = tmp_path / "failed-key"
    folder.mkdir()
    report = {
        "scene": "leaves",
        "images": 20,
        "registered": 4,
        "points": 17,
        "reprojection_error_px": 0.514,
        "attempts": [
            {"attempt": "configured", "refused": "COLMAP placed 2 of 20 views"},
            {"attempt": "finer", "refused": "", "registered": 4},
        ],
        "pose_error": {"rotation_degrees": 0.25, "rotation_degrees_max": 1.5},
        "pose_error_against": "SfM of the undegraded photographs",
        "tags": "megapixels",
        "degradation": "none",
        "rho": {"LR": [0.1, 0.2, 0.3]},
        "not_registered": ["x", "y"],
        "unreadable": ["z.png: truncated"],
    }
    (folder / "report.json").write_text(json.dumps(report))
    text = inspect.describe(folder)
    for line in (
        "leaves: failed",
        "SfM: 4 of 20 views placed, 17 points, 0.51 px",
        "recipe configured: COLMAP placed 2 of 20 views",
        "recipe finer: accepted, 4 placed",
        "against SfM of the undegraded photographs: rotation 0.250 degrees, at most 1.500",
        "tags by megapixels, degradation none",
        "rho of LR: 0.100, 0.200, 0.300",
        "not placed: x, y",
        "unreadable: z.png: truncated",
    ):
        assert line in text
    assert "position" not in text
    (folder / "report.json").write_text("{}")
    assert "0 of ? views" in inspect.describe(folder)
    shutil.rmtree(folder)
    with pytest.raises(XrgsError, match="failed-key: no such folder"):
        inspect.describe(folder)


def test_borders_tell_the_tag(mixed: Variant) -> None:
    found = tiles(contact_sheet(mixed))
    assert [tile[1, 1].tolist() for tile in found] == [
        rgb(COLOURS[k]) for k in ("HR", "LR", "test")
    ]


def test_the_centre_shows_the_pixels_as_they_are(mixed: Variant) -> None:
    high, low, _ = tiles(contact_sheet(mixed))
    whole = np.asarray(Image.open(mixed.views[2].file))
    assert np.array_equal(high[4:196, 264:456], whole[54:246, 104:296])
    small = np.asarray(Image.open(mixed.views[3].file))
    centre = low[4:196, 264:456]
    for k in range(5):  # each pixel a square of 5
        block = centre[k::5, k::5]
        assert np.array_equal(block, small[10:, 20:][: len(block), : len(block)])


def test_a_small_view_is_magnified_and_a_large_one_shrunk(mixed: Variant) -> None:
    high, low, _ = tiles(contact_sheet(mixed))
    whole = np.asarray(Image.open(mixed.views[2].file).resize((256, 192), Image.Resampling.BOX))
    assert np.array_equal(high[4:196, 4:260], whole)
    shown = {tuple(pixel) for pixel in low[4:196, 4:260].reshape(-1, 3).tolist()}
    stored = {tuple(p) for p in np.asarray(Image.open(mixed.views[3].file)).reshape(-1, 3).tolist()}
    assert shown == stored  # no pixel is blended with another


def test_names_that_are_too_long_or_of_another_script_are_drawn(
    mixed: Variant, tmp_path: Path
) -> None:
    names = ("x" * 200, "фото 写真", "")
    views = tuple(replace(v, name=n) for v, n in zip(mixed.views[1:], names, strict=True))
    sheet = contact_sheet(replace(mixed, views=views, scene="s" * 500))
    assert sheet.size == contact_sheet(mixed).size


def test_a_view_that_is_gone_is_named(mixed: Variant) -> None:
    mixed.views[2].file.unlink()
    with pytest.raises(XrgsError, match=r"a\.png: unreadable or truncated"):
        contact_sheet(mixed)


def test_a_scene_of_another_s_words_is_drawn_on_one_line(mixed: Variant) -> None:
    sheet = contact_sheet(replace(mixed, scene="a\nb\x1b"))
    assert np.array_equal(
        np.asarray(sheet), np.asarray(contact_sheet(replace(mixed, scene="a b ")))
    )


def test_what_a_failed_variant_says_is_not_obeyed(tmp_path: Path) -> None:
    folder = tmp_path / "failed-key"
    folder.mkdir()
    attempt = {"attempt": "a\nb\x1b[2J", "refused": "\x1b]0;t\x07"}
    report = {"scene": "x\n\x1b[2J", "attempts": [attempt], "unreadable": ["\u202ey"]}
    (folder / "report.json").write_text(json.dumps(report))
    lines = inspect.describe(folder).split("\n")
    assert lines[0] == "x  [2J: failed, so there are no views"
    assert lines[3:] == ["  recipe a b [2J:  ]0;t ", "  unreadable:  y"]
