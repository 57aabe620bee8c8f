"""What is in the page, without a browser."""

from __future__ import annotations

import base64
import hashlib
import html
import json
import re
import shutil
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.report.conftest import MadeStore, configured
from tests.report.html.conftest import HOSTILE, HR, data_of, make_gaussians, page_of
from xrgs.evaluation.metrics import METRICS
from xrgs.formats.ply import save_ply
from xrgs.photos import images
from xrgs.report import build
from xrgs.report.compare import compare
from xrgs.report.html import content, document
from xrgs.report.html.content import summary
from xrgs.report.html.images import Album, error_map
from xrgs.store.store import Store


class Parsed(HTMLParser):
    """The elements of a page, and the text in each kind of them."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.texts: dict[str, list[str]] = {}
        self._open = ""
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        self._open = tag

    def handle_data(self, data: str) -> None:
        self.texts.setdefault(self._open, []).append(data)


@pytest.mark.slow
def test_the_page_of_one_cell_shows_the_scene_and_no_furniture_of_a_comparison(alone: Path) -> None:
    parsed = Parsed(alone.read_text())
    order = [attributes["id"] for tag, attributes in parsed.tags if tag == "section"]
    sections = "answer splats views photographs training curves made tables"
    assert order == sections.split()
    assert parsed.texts["h1"][0] == "fern"
    data = data_of(alone)
    assert data["single"]
    assert data["mixed"] == (alone.parent.name == "mixed")
    assert [view["view"] for view in data["views"]] == ["IMG_009", "IMG_001"], "worst first"
    words = " ".join(text for tag, of in parsed.texts.items() if tag != "script" for text in of)
    furniture = ("No ablation", "Change from", "Every change", "paper", "Compared with", "arms")
    assert not [text for text in furniture if text in words]
    assert "it is unknown how the photographs were placed" in words
    terms, texts = ([text for text in parsed.texts[of] if text.strip()] for of in ("dt", "dd"))
    values = dict(zip(terms, texts, strict=True))
    scores = {"PSNR": "20.00 dB", "SSIM": "0.8000", "LPIPS": "0.2500"}
    assert values == scores | {"Gaussians": "5,000", "Training time": "100 s"}
    if not data["mixed"]:
        assert not {"HR", "LR"} & set(re.findall(r"\w+", words))


@pytest.mark.slow
@pytest.mark.parametrize("alone", ["alike"], indirect=True)
def test_the_page_of_one_cell_says_how_the_scene_was_placed(alone: Path, tmp_path: Path) -> None:
    store = Path(shutil.copytree(alone.parent.parent / "store", tmp_path / "store"))
    (report,) = store.glob("variants/0123*/report.json")
    found = {"images": 6, "registered": 5, "points": 1234, "reprojection_error_px": 0.567}
    report.write_text(json.dumps(json.loads(report.read_text()) | found))
    page = html.unescape((build(store, pictures=[]).folder / "report.html").read_text())
    text = "5 of 6 photographs are placed by structure from motion, 1,234 points, mean reprojection"
    assert f"<li>{text} error 0.57 px</li>" in page
    assert 'id="splats"' not in page
    assert "were left out: --pictures none" in page


def test_everything_of_the_store_is_there(page: Path) -> None:
    assert page.stat().st_size < document.MAX_BYTES
    data = data_of(page)
    labels = ["baseline", "consistency", HOSTILE]
    assert [view["view"] for view in data["views"]] == ["IMG_009", "IMG_001"], "worst first"
    for entry in data["views"] + data["training"]:
        assert [arm["label"] for arm in entry["arms"]] == labels
        urls = [data["images"][arm["image"]] for arm in entry["arms"]]
        assert all(url.startswith("data:image/webp") for url in urls)
    tags = [(view["view"], view["tag"], view["original"] is None) for view in data["training"]]
    assert tags == [("IMG_003", "LR", False), ("IMG_004", "LR", False), ("IMG_002", "HR", True)]
    assert [model["label"] for model in data["models"]] == labels
    assert all(model["count"] == model["total"] == 200 for model in data["models"])
    assert len(data["curves"]) == len(data["history"]) == len(data["trade_offs"]) == 3
    assert [camera["kind"] for camera in data["cameras"][0]["cameras"]] == [
        *("HR", "LR", "LR"),
        *("test", "test"),
    ]
    assert data["notes"] == []


def test_the_table_of_changes_has_no_column_that_is_empty_in_every_row(
    made: MadeStore, page: Path
) -> None:
    assert _heads(page) == ["Ablation", "Metric", "Change", "baseline", "Value"]
    for scene, factor in (("fern", 1.1), ("leaves", 1.3)):
        made.add(scene=scene)
        made.add("consistency", scene=scene, factors={"psnr": factor})
    made.write()
    several = build(made.store.path, pictures=[]).folder / "report.html"
    assert _heads(several)[:5] == ["Ablation", "Scene", "Metric", "Change", "Verdict"]
    assert _heads(several)[7:] == ["From", "To", "Same sign"]  # two values have no q
    text = several.read_text()
    assert re.search(r"<th[^>]*>leaves PSNR ↑</th>", text)
    assert '<p class="note">2 test views a scene</p>' in text
    scenes = re.findall(r'data-scene="(.*?)"', page.read_text())
    assert set(scenes) == {"fern"}  # the filter of scenes finds the only one


def _heads(page: Path) -> list[str]:
    """The heads of the table of all changes."""
    table = page.read_text().partition('id="changes-table"')[2].partition("</thead>")[0]
    return re.findall(r"<th(?: [^>]*)?>(.*?)</th>", table)


def test_a_copy_of_some_changes_has_whole_rows(page: Path) -> None:
    rows = re.findall(r'data-label="(.*?)" data-scene=".*?" data-metric="(.*?)"', page.read_text())
    for form in ("latex", "markdown", "csv"):
        changes = data_of(page)["changes"][form]
        assert len(rows) == len(changes["rows"]) == 22
        for (label, metric), line in zip(rows, changes["rows"], strict=True):
            assert metric in line
            assert label in line or label != "consistency"
        assert not any("PSNR" in line for line in changes["head"] + changes["foot"])


def test_nothing_of_the_store_is_markup(page: Path) -> None:
    parsed = Parsed(page.read_text())
    assert [tag for tag, _ in parsed.tags].count("script") == 2
    assert not [tag for tag, attributes in parsed.tags if "onerror" in attributes]
    assert not [1 for _, attributes in parsed.tags if "style" in attributes]
    assert HOSTILE in "".join(parsed.texts["h3"])
    assert "49" not in re.findall(r"<h3>(.*?)</h3>", page.read_text())  # not a template either


def test_the_policy_names_the_style_and_the_script_alone(page: Path) -> None:
    parsed = Parsed(page.read_text())
    policy = next(a["content"] or "" for tag, a in parsed.tags if a.get("http-equiv"))
    assert policy.startswith("default-src 'none';")
    assert "unsafe" not in policy
    assert "http" not in policy
    for tag in ("style", "script"):
        text = re.findall(rf"<{tag}>(.*?)</{tag}>", page.read_text(), re.DOTALL)[0]
        digest = base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()
        assert f"{tag}-src 'sha256-{digest}'" in policy


@pytest.mark.slow
def test_a_damaged_file_costs_what_it_shows_alone(copied: Path) -> None:
    (home,) = copied.glob("variants/0123*/images/test")
    mask = np.ones(HR[::-1], bool)
    mask[: HR[1] // 4] = False
    home.with_name("test-masks").mkdir()
    images.save_mask(home.with_name("test-masks") / "IMG_001.png", mask)
    cells = copied / "cells"
    for file in (cells / "cell00001/splats.ply", cells / "cell00000/renders/IMG_001.png"):
        file.write_bytes(b"x" * file.stat().st_size)  # of the same size: the cell is still done
    gaussians = make_gaussians(1)
    gaussians.scales[3, 1] = 1e30
    save_ply(cells / "cell00002/splats.ply", gaussians)
    data = data_of(page_of(copied))
    assert len(data["notes"]) == 3
    notes = "\n".join(data["notes"])
    assert "fern, IMG_001: no render of baseline" in notes
    assert "fern, consistency: no training views and no model" in notes
    assert "not finite" in notes
    assert str(copied) not in notes
    worst, other = data["views"]
    labels = ["baseline", "consistency", HOSTILE]
    assert [arm["label"] for arm in worst["arms"] if "image" in arm] == labels
    assert [arm["label"] for arm in other["arms"] if "image" in arm] == labels[1:]
    assert (worst["hidden"], other["hidden"]) == (0, 0.25), "by a mask"
    assert [model["label"] for model in data["models"]] == ["baseline"]


@pytest.mark.slow
def test_a_page_that_is_too_large_says_what_it_left_out(
    copied: Path, page: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(document, "MAX_BYTES", page.stat().st_size - 10)
    data = data_of(page_of(copied))
    assert data["history"] == []
    assert data["models"]
    assert data["notes"] == ["The page has no history: with it, it would be too large."]
    monkeypatch.undo()
    monkeypatch.setattr(document, "_VIEW_BYTES", 10)
    data = data_of(page_of(copied))
    assert ["photograph" in view for view in data["views"]] == [False, False]
    assert data["notes"][0].startswith("The images of 2 of 2 test views are left out")


def test_an_album_keeps_an_image_once_and_its_size() -> None:
    red, blue = (Image.new("RGB", (20, 10), name) for name in ("red", "blue"))
    urls = ["data:another"]
    album = Album(urls, 10_000, 400)
    assert album.add([red, blue]) == [1, 2]
    assert album.add([blue, red]) == [2, 1]
    assert len(urls) == 3
    assert Album(urls, 10, 400).add([red]) is None


def test_an_error_map_is_brightest_where_the_render_is_wrong() -> None:
    photograph, render = np.zeros((8, 8, 3), np.uint8), np.zeros((8, 8, 3), np.uint8)
    render[:4] = 128
    drawn = np.asarray(error_map(Image.fromarray(photograph), Image.fromarray(render)), int)
    assert drawn.shape == (4, 4, 3)
    assert drawn[0].sum() > 10 * drawn[-1].sum()
    with pytest.raises(ValueError, match="size"):
        error_map(Image.fromarray(photograph), Image.new("RGB", (4, 4)))


def test_without_pictures_there_are_tables_and_the_arms_that_differ(
    copied: Path,
) -> None:
    densify = {"prune_scale3d": 10.0}
    configured(Store(copied).cell("cell00001"), splat={"densify": densify})
    page = build(copied, pictures=[]).folder / "report.html"
    text, data = html.unescape(page.read_text()), data_of(page)
    assert data["images"] == data["models"] == data["training"] == []
    assert [view["view"] for view in data["views"]] == ["IMG_009", "IMG_001"]
    assert "--pictures none" in text
    assert f"Gaussians above 0.1 (baseline, {HOSTILE}), 10 (consistency) times" in text
    assert "<td>1 HR (48 × 36 px); 2 LR (24 × 18 px); 2 test (48 × 36 px)</td>" in text
    caution = '<p class="warning">Caution: fern has 2 scored views: its scores say little of other'
    assert caution in text


def test_a_page_has_the_first_replicates_of_all_scenes_and_says_how_many_it_leaves_out(
    made: MadeStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    for seed in (0, 1):
        for scene in ("fern", "leaves"):
            made.add(scene=scene, seed=seed)
            made.add("consistency", scene=scene, seed=seed)
    made.write()
    monkeypatch.setattr(content, "_MAX_RUNS", 3)
    report = build(made.store.path, pictures=[])
    data = data_of(report.folder / "report.html")
    shown = [("fern", "0/0"), ("leaves", "0/0"), ("fern", "0/1")]
    for part in ("views", "history"):
        runs = [(of["scene"], of["replicate"]) for of in data[part]]
        assert list(dict.fromkeys(runs)) == shown
        assert {runs.count(run) for run in shown} == {2}, "two views, and two cells"
    assert any(note.startswith("Views and curves are of 3 of 4 runs (") for note in data["notes"])
    assert (report.folder / "views.csv").read_text().count("\n") == 1 + 8 * 2


def test_the_summary_of_one_label_keeps_conditions_apart(tmp_path: Path) -> None:
    made = MadeStore(tmp_path / "store")
    for value, psnr in ((2, 20.0), (5, 10.0)):
        made.add(condition=f"variant.factor={value}", values={"psnr": psnr})
    found = {
        name: dict(rows)["PSNR"] for name, rows in summary(compare(made.read().cells, METRICS))
    }
    assert found == {"fern (variant.factor=2)": "20.00 dB", "fern (variant.factor=5)": "10.00 dB"}
