"""A variant's table and contact sheet: true to its views, and clear where there is no variant."""

from __future__ import annotations

import errno
import json
import os
import re
import resource
import shutil
import zlib
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any, Literal

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
from xrgs.store.contact_sheet import COLOURS, contact_sheet
from xrgs.store.inspect import SfmReport, describe, shared_cameras, views_table

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


def test_of_a_scene_that_failed_the_notes_are_all_there_is() -> None:
    assert SfmReport(notes=("n",), not_registered=("a",)).all_notes() == ("n",)


@pytest.mark.slow
def test_a_variant_is_described_and_drawn(
    xrgs_data: Run, tmp_path: Path, smoke_variants: Path
) -> None:
    shutil.copytree(smoke_variants, tmp_path / "s" / "variants")
    arguments = ("scene=motorcycle", "preset=smoke", "store=s", "--out", "sheet.png")
    code, out, err = xrgs_data("inspect", *arguments)
    assert code == 0, err
    for text in ("motorcycle_left", "motorcycle_right", "250 x 165", "50 x 33", "2 of 2 views"):
        assert text in out
    drawn = (tmp_path / "sheet.png").read_bytes()
    folder = next((tmp_path / "s" / "variants").glob("[!.]*"))
    code, again, err = xrgs_data("inspect", str(folder.relative_to(tmp_path)), "--out", "sheet.png")
    assert code == 0, err
    assert again == out
    assert (tmp_path / "sheet.png").read_bytes() == drawn

    code, out, err = xrgs_data("inspect", *arguments[:-1], "no/sheet.png")
    assert code == 1
    assert "--out no/sheet.png: can't be written" in err
    image = next(folder.rglob("motorcycle_left.png"))
    image.write_bytes(image.read_bytes()[:-1])
    code, out, err = xrgs_data("inspect", str(folder))
    assert code == 1
    assert "motorcycle_left.png: it has changed since it was written" in err
    (folder / "variant.json").unlink()
    code, out, err = xrgs_data("inspect", str(folder))
    assert code == 1
    assert out == ""
    # Without its manifest it is a folder of photographs, and has none at the top.
    assert f"scene.path={folder}" in err
    assert "takes the images of all folders" in err


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
        (1, "jpeg", (NEEDS,), True, (NEEDS,)),
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
        ([1.0, 1.2, 1.4, 1.45], r"^hardly a mixture: 0 of 4 .*tuned_baseline"),
        ([1.0, 1.0, 1.0, 1.0, 3.0], r"^hardly a mixture: 1 of 5 .*tuned_baseline"),
        ([1.0, 1.0, 1.0, 1.6], r"^a mixture: 1 of 4 .*plus"),
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
    shutil.rmtree(folder)
    for path in (folder, folder / "inside"):
        with pytest.raises(XrgsError, match=f"{path}: no such folder"):
            describe(path)


def test_borders_tell_the_tag(mixed: Variant) -> None:
    found = tiles(contact_sheet(mixed)[0])
    assert [tile[1, 1].tolist() for tile in found] == [
        rgb(COLOURS[k]) for k in ("HR", "LR", "test")
    ]


def test_the_centre_shows_the_pixels_as_they_are(mixed: Variant) -> None:
    high, low, _ = tiles(contact_sheet(mixed)[0])
    whole = np.asarray(Image.open(mixed.views[2].file))
    assert np.array_equal(high[4:196, 264:456], whole[54:246, 104:296])
    small = np.asarray(Image.open(mixed.views[3].file))
    centre = low[4:196, 264:456]
    for k in range(5):  # each pixel a square of 5
        block = centre[k::5, k::5]
        assert np.array_equal(block, small[10:, 20:][: len(block), : len(block)])


def test_a_small_view_is_magnified_and_a_large_one_shrunk(mixed: Variant) -> None:
    high, low, _ = tiles(contact_sheet(mixed)[0])
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
    sheet = contact_sheet(replace(mixed, views=views, scene="s" * 500))[0]
    assert sheet.size == contact_sheet(mixed)[0].size


@pytest.mark.slow
@pytest.mark.parametrize(
    ("damage", "why"),
    [
        ("gone", "No such file or directory"),
        ("a JPEG", "cannot identify"),
        ("truncated", "truncated"),
        ("another size", "it has 13000 x 13000 pixels"),
        ("too few bytes", "bytes are too few for 400 x 300 px"),
        ("too large", "at most"),
    ],
)
def test_one_image_that_cant_be_read_does_not_take_the_sheet(
    mixed: Variant, damage: str, why: str
) -> None:
    view, file = mixed.views[2], mixed.views[2].file
    content = file.read_bytes()
    file.unlink()
    if damage == "a JPEG":
        Image.new("RGB", (400, 300)).save(file, "JPEG")
    elif damage == "truncated":
        file.write_bytes(content[: len(content) // 2])
    elif damage in {"another size", "too large"}:
        file.write_bytes(flat_png(13_000, 13_000))
    elif damage == "too few bytes":
        file.write_bytes(flat_png(400, 300)[:200])
    if damage == "too large":
        view = replace(view, width=13_000, height=13_000)
    views = (*mixed.views[:2], view, mixed.views[3])
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    sheet, notes = contact_sheet(replace(mixed, views=views))
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 200_000  # kB
    assert len(notes) == 1
    assert str(file) in notes[0]
    assert why in notes[0]
    high, low, held_out = tiles(sheet)
    assert len(np.unique(high[4:196, 4:456])) > 1  # it says so
    assert held_out[4:196, 4:260].std() > 20  # the others are drawn as ever
    assert low[4:196, 4:260].std() > 20


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


@cache
def flat_png(width: int, height: int) -> bytes:
    """A black PNG, made without its pixels in memory: 13,000 px a side take 2 MB."""
    row = b"\0" * (3 * width + 1)
    compressor = zlib.compressobj(1)
    data = b"".join([*(compressor.compress(row) for _ in range(height)), compressor.flush()])
    head = width.to_bytes(4, "big") + height.to_bytes(4, "big") + b"\x08\x02\0\0\0"
    chunks = ((b"IHDR", head), (b"IDAT", data), (b"IEND", b""))
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        len(body).to_bytes(4, "big") + kind + body + zlib.crc32(kind + body).to_bytes(4, "big")
        for kind, body in chunks
    )


def test_only_so_many_views_are_drawn(mixed: Variant, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("xrgs.store.contact_sheet._MAX_TILES", 2)
    sheet, notes = contact_sheet(mixed)
    assert notes == ["the first 2 of 3 views"]
    two = contact_sheet(replace(mixed, views=(mixed.views[2], mixed.views[3])))[0]
    assert np.array_equal(np.asarray(sheet)[32:], np.asarray(two)[32:])  # below the legend


@pytest.mark.parametrize(
    ("wrong", "field"),
    [({"lr": 5}, "lr"), ({"rho": {"HR": ["a"]}}, "rho"), ({"attempts": [1]}, r"attempts\[0\]")],
)
def test_a_damaged_report_is_named_with_its_field(
    tmp_path: Path, wrong: dict[str, Any], field: str
) -> None:
    folder = tmp_path / "failed-key"
    folder.mkdir()
    (folder / "report.json").write_text(json.dumps({"scene": "x"} | wrong))
    with pytest.raises(XrgsError, match=rf"damaged: \S+report\.json: {field}"):
        describe(folder)


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


def test_a_scene_of_another_s_words_is_drawn_on_one_line(mixed: Variant) -> None:
    sheet = contact_sheet(replace(mixed, scene="a\nb\x1b"))[0]
    plain = contact_sheet(replace(mixed, scene="a b "))[0]
    assert np.array_equal(np.asarray(sheet), np.asarray(plain))
