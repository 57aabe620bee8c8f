"""A variant's table and contact sheet: true to its views, and clear where there is no variant."""

from __future__ import annotations

import errno
import json
import os
import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from xrgs.errors import XrgsError
from xrgs.mixture import variant
from xrgs.mixture.saved_variant import Manifest, ViewEntry
from xrgs.mixture.views import Variant, View
from xrgs.photos import images
from xrgs.runtime.text import to_text
from xrgs.safeio.sanitize import MAX_LINE
from xrgs.store import inspect
from xrgs.store.inspect import (
    COLOURS,
    SfmReport,
    contact_sheet,
    describe,
    shared_cameras,
    views_table,
)

Run = Callable[..., tuple[int, str, str]]


def view(folder: Path, name: str, split: str, tag: str, size: tuple[int, int], rho: float) -> View:
    """Of noise: no two of its pixels are alike."""
    file = folder / split / f"{name}.png"
    file.parent.mkdir(exist_ok=True)
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
    nothing = np.zeros((0, 3))
    colors = nothing.astype(np.uint8)
    return Variant("key-hash", tmp_path, "room", 5, True, views, nothing, colors, {})


def tiles(sheet: Image.Image, columns: int = 2) -> list[np.ndarray]:
    """Each view's tile, in order: its border is what is found at the tile's own place."""
    step, top = (468, 228), 32
    return [
        np.asarray(sheet)[top + (i // columns) * step[1] :, 8 + (i % columns) * step[0] :]
        for i in range(3)
    ]


def rgb(colour: str) -> list[int]:
    return [int(colour[i : i + 2], 16) for i in (1, 3, 5)]


def test_views_that_are_not_placed_are_named_by_what_they_lack() -> None:
    """Without held-out views, the training views are scored."""
    report = SfmReport(notes=("n",), tests=2, hr=("a",), lr=("b", "c"), not_registered=("b", "t"))
    untrained, unscored = "not placed, and so not trained on: b", "not placed, and so not scored: "
    assert report.all_notes() == ("n", untrained, f"{unscored}t")
    report.tests = 0
    assert report.all_notes() == ("n", untrained, f"{unscored}b, t")
    report.not_registered = tuple(f"v{i}" for i in range(9))
    report.tests = 1
    assert report.all_notes()[1:] == (f"{unscored}v0, v1, v2, v3, v4, v5 and 3 more",)
    assert report.all_notes(9)[1].endswith("v7, v8")
    # A scene that failed, whose reason names the views.
    assert SfmReport(notes=("n",), not_registered=("a",)).all_notes() == ("n",)


def test_a_sheet_that_can_not_be_written_here_says_how_to_name_another(
    mixed: Variant, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def unwritable(_: Path) -> None:
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))

    monkeypatch.setattr(variant, "load", lambda _: mixed)
    monkeypatch.setattr(inspect, "read_report", lambda _: SfmReport())
    monkeypatch.setattr(inspect, "atomic_writer", unwritable)
    with pytest.raises(XrgsError) as caught:
        describe(tmp_path)
    assert str(caught.value) == (
        "the sheet key-hash.png can't be written here (Permission denied); give --out=FILE.png"
    )
    with pytest.raises(XrgsError, match=r"^out=x\.png: can't be written"):
        describe(tmp_path, Path("x.png"))


@pytest.mark.parametrize("held_out", [True, False])
def test_views_of_one_camera_are_named(held_out: bool) -> None:
    """A copy is placed 0.05 degrees and 0.5 % off; neighbours are 0.5 degrees apart."""
    angles, places = [0, 0.5, 1, 0.05, 0], [0, 0.1, 1, 0.005, 1]
    splits: tuple[Literal["train", "test"], ...] = ("test", "train", "train", "train", "train")
    K = np.eye(3).tolist()
    views = []
    for name, split, angle, place in zip("abcde", splits, angles, places, strict=True):
        viewmat = np.eye(4)
        viewmat[:3, :3] = Rotation.from_euler("y", angle, degrees=True).as_matrix()
        viewmat[:3, 3] = viewmat[:3, :3] @ [-2 * place, 0, 0]
        views.append(ViewEntry(name, split, "", "HR", 9, 9, K, viewmat.tolist(), 1.0))
    said = shared_cameras(Manifest("k", "s", 5, held_out, tuple(views), {}))
    copies = (
        "views of one camera, as copies of a photograph are; remove one: a (test) and d (train)"
    )
    assert said == ([copies] if held_out else [])


def test_the_table_has_a_row_a_view_and_leaves_originals_out(mixed: Variant) -> None:
    report = SfmReport(hr=("a",), lr=("b-low", "lost"), not_registered=("lost", "gone"))
    table = views_table(mixed, report)
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


MEANINGLESS = "the split by variant.tags=sampling_rate is meaningless: rho is 0.916 to 1.000"
NEEDS = "sampling rates of training views differ by 1.1 where they show the same points: none"


@pytest.mark.parametrize(
    ("factor", "degradation", "notes", "tagged", "said"),
    [
        (1, "none", (MEANINGLESS, NEEDS, "left out: a.gif"), False, ("left out: a.gif",)),
        (1, "none", (NEEDS,), True, ()),  # a mixture
        (2, "none", (MEANINGLESS, NEEDS), True, (MEANINGLESS, NEEDS)),  # a study asks for LR views
    ],
)
def test_photographs_as_they_are_are_described_without_a_split(
    mixed: Variant,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    factor: int,
    degradation: str,
    notes: tuple[str, ...],
    tagged: bool,
    said: tuple[str, ...],
) -> None:
    content = {
        "images": 3,
        "registered": 3,
        "tags": "sampling_rate",
        "degradation": degradation,
        "lr_images": "upsampled",
        "max_num_features": 9,
        "hr": ["a"],
        "lr": ["b-low"],
        "rho": {"HR": [1, 1, 1], "LR": [0.9, 0.9, 0.9]},
        "lr_blur": 0.3,
        "notes": notes,
    }
    (tmp_path / "report.json").write_text(json.dumps(content))
    entry = ViewEntry("a", "train", "", "HR", 9, 9, np.eye(3).tolist(), np.eye(4).tolist(), 1.0)
    manifest = Manifest("k", "s", factor, True, (entry,), {})
    monkeypatch.setattr(inspect, "read_manifest", lambda _: manifest)
    monkeypatch.setattr(variant, "load", lambda _: replace(mixed, factor=factor))
    assert inspect.read_report(tmp_path).all_notes() == said
    text = describe(tmp_path, tmp_path / "sheet.png")
    words = {"HR", "LR", "Tag", "tags"} & set(re.findall(r"\w+", text))
    assert words == ({"HR", "LR", "Tag", "tags"} if tagged else set())
    for note in notes:
        assert (note in text) == (note in said)


@pytest.mark.parametrize(
    ("needs", "said"),
    [
        ([1.0, 1.0, 1.0, 1.0, 3.0], r"^hardly a mixture: 1 of 5 .*plus"),
        ([1.0, 1.0, 1.0, 1.6], r"^a mixture: 1 of 4 .*plus and .*lean"),
    ],
)
def test_it_says_whether_it_is_a_mixture(
    mixed: Variant, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, needs: list[float], said: str
) -> None:
    original, test, train, _ = mixed.views
    views = [replace(train, name=str(i), supersampling=need) for i, need in enumerate(needs)]
    made = replace(mixed, views=(original, test, *views))
    monkeypatch.setattr(variant, "load", lambda _: made)
    monkeypatch.setattr(inspect, "read_report", lambda _: SfmReport())
    assert re.search(said, describe(tmp_path, tmp_path / "sheet.png"), re.MULTILINE)


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
        "lr_blur": 0.314,
        "not_registered": ["x", "y"],
    }
    (folder / "report.json").write_text(json.dumps(report))
    text = describe(folder)
    for line in (
        "leaves: failed",
        "SfM: 4 of 20 views placed, 17 points, 0.51 px",
        "recipe configured: COLMAP placed 2 of 20 views",
        "recipe finer: accepted, 4 placed",
        "against SfM of the undegraded photographs: rotation 0.250 degrees, at most 1.500",
        "tags by megapixels, degradation none",
        "rho of LR: 0.100, 0.200, 0.300",
        "blur of LR: 0.31 px, estimated (a pixel's area has 0.29)",
        "not placed: x, y",
    ):
        assert line in text
    assert "position" not in text
    (folder / "report.json").write_text("{}")
    assert "0 of ? views" in describe(folder)
    (folder / "report.json").write_text('{"attempts": [1]}')
    with pytest.raises(XrgsError, match=r"damaged: \S+report\.json: attempts\[0\]"):
        describe(folder)
    shutil.rmtree(folder)
    for path in (folder, folder / "inside"):
        with pytest.raises(XrgsError, match=f"{path}: no such folder"):
            describe(path)


def test_the_sheet_shows_each_view_in_its_colour_and_its_centre_pixel_by_pixel(
    mixed: Variant,
) -> None:
    names = ("x" * 200, "фото 写真", "")  # too long for a tile, or of another script
    views = tuple(replace(v, name=n) for v, n in zip(mixed.views[1:], names, strict=True))
    size = contact_sheet(replace(mixed, views=views, scene="a\nb\x1b" + "s" * 500))[0].size
    sheet, _ = contact_sheet(mixed)
    assert sheet.size == size
    high, low, held_out = tiles(sheet)
    assert [tile[1, 1].tolist() for tile in (high, low, held_out)] == [
        rgb(COLOURS[k]) for k in ("HR", "LR", "test")
    ]
    whole = Image.open(mixed.views[2].file)
    shrunk = np.asarray(whole.resize((256, 192), Image.Resampling.BOX))
    assert np.array_equal(high[4:196, 4:260], shrunk)
    assert np.array_equal(high[4:196, 264:456], np.asarray(whole)[54:246, 104:296])
    small = np.asarray(Image.open(mixed.views[3].file))
    centre = low[4:196, 264:456]
    for k in range(5):  # each pixel a square of 5
        block = centre[k::5, k::5]
        assert np.array_equal(block, small[10:, 20:][: len(block), : len(block)])
    shown = {tuple(pixel) for pixel in low[4:196, 4:260].reshape(-1, 3).tolist()}
    assert shown == {tuple(pixel) for pixel in small.reshape(-1, 3).tolist()}  # none is blended


def test_one_image_that_cant_be_read_does_not_take_the_sheet(
    mixed: Variant, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = mixed.views[2].file
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    sheet, notes = contact_sheet(mixed)
    assert len(notes) == 1
    assert str(file) in notes[0]
    assert "truncated" in notes[0]
    high, low, held_out = tiles(sheet)
    assert len(np.unique(high[4:196, 4:456])) > 1  # it says so
    assert held_out[4:196, 4:260].std() > 20  # the others are drawn as ever
    assert low[4:196, 4:260].std() > 20
    monkeypatch.setattr("xrgs.store.inspect._MAX_TILES", 2)
    assert contact_sheet(mixed)[1][0] == "the first 2 of 3 views"


def test_what_is_outside_a_mask_is_dark(mixed: Variant, tmp_path: Path) -> None:
    used = np.zeros((300, 400), np.bool_)
    used[:, 200:] = True
    images.save_mask(tmp_path / "mask.png", used)
    view = replace(mixed.views[2], mask=tmp_path / "mask.png")
    plain, _ = contact_sheet(mixed)
    masked, notes = contact_sheet(replace(mixed, views=(*mixed.views[:2], view, mixed.views[3])))
    before, after = (tiles(sheet)[0][4:196, 4:260].astype(float) for sheet in (plain, masked))
    assert notes == []
    assert (after[:, 130:] == before[:, 130:]).all()
    assert after[:, :126].mean() == pytest.approx(before[:, :126].mean() / 4, rel=0.02)


def test_nothing_of_a_report_reaches_the_terminal_as_an_escape(tmp_path: Path) -> None:
    folder = tmp_path / "failed-key"
    folder.mkdir()
    evil = "\x1b[2J\x07\n" + "x" * 5_000
    report = {
        "scene": evil,
        "lr_images": evil,
        "tags": evil,
        "notes": [evil],
        "attempts": [{"attempt": evil, "refused": evil}],
    }
    (folder / "report.json").write_text(json.dumps(report))
    lines = describe(folder).split("\n")
    assert all(line.isprintable() for line in lines)
    assert len(lines) == 6
    assert max(map(len, lines)) <= MAX_LINE
