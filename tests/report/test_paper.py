"""The paper's tables, its claim on texture and its figures beside a sweep's own results."""

import csv
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from scipy.stats import spearmanr

from xrgs.evaluation.metrics import METRICS
from xrgs.report.collect import ReportStore
from xrgs.report.compare import compare
from xrgs.report.context import Context
from xrgs.report.page import build
from xrgs.report.paper import paper_tables, texture_tables, why_no_table, with_texture
from xrgs.runtime.text import TextTable
from xrgs.store.trimming import trim_variant

SCENES = ("fern", "flower", "horns")


def tables(made: Any, against: str = "baseline") -> list[TextTable]:
    return paper_tables(compare(made.read().cells, METRICS, against), {"": Context(("500 steps",))})


def add(made: Any, scene: str, label: str = "xrgs", *, seed: int = 0, **factors: float) -> None:
    """A baseline, and a cell whose metrics are the baseline's times these factors."""
    made.add(scene=scene, seed=seed)
    made.add(label, scene=scene, seed=seed, factors=factors)


def signs(table: TextTable) -> dict[str, str]:
    return {row[1]: row[-1] for row in table.rows}


def test_a_sign_is_confirmed_refuted_or_open(made: Any) -> None:
    for scene, gaussians, ssim, psnr in zip(
        SCENES, (0.3, 0.31, 0.33), (0.9, 0.91, 0.92), (0.9, 1.0, 1.1), strict=True
    ):
        add(made, scene, gaussians=gaussians, ssim=ssim, psnr=psnr)
    (table,) = tables(made)
    assert table.title == "Beside the paper's Table 1: mean over 3 scenes"
    assert table.context == "500 steps"
    found = signs(table)
    assert found["Gaussians"] == "confirmed"  # -69.68 in the paper
    assert found["SSIM"] == "refuted"  # +0.45
    assert found["PSNR"] == "open"  # -0.80
    assert "Render time" not in found  # the paper has no number of it
    rows = {row[1]: row for row in table.rows}
    assert rows["Gaussians"][2] == "-69.68 ↑"
    assert rows["LPIPS"][2] == "+23.15 ↓"


def test_a_size_stands_beside_the_papers_where_the_quantity_is_the_same(made: Any) -> None:
    for scene, off in zip(SCENES, (0.99, 1.0, 1.01), strict=True):
        add(made, scene, lpips=1.463 * off, memory_bytes=0.535 * off, psnr=1.008 * off)
    (table,) = tables(made)
    column = table.columns.index("here / paper")
    rows = {row[1]: row for row in table.rows}
    assert rows["LPIPS"][column] == "2.00"  # +46.3 % beside +23.15 %
    assert rows["PSNR"][column] == "-1.00"  # +0.80 % beside -0.80 %
    assert rows["Memory"][column] == ""
    assert rows["Memory"][-1] == "not comparable"
    assert any(note.startswith("Memory is not comparable: ") for note in table.notes)


def test_two_values_leave_a_sign_open(made: Any) -> None:
    for scene in SCENES[:2]:
        add(made, scene, gaussians=0.3)
    (table,) = tables(made)
    assert signs(table)["Gaussians"] == "open"


@pytest.mark.parametrize(
    ("scene", "column"), [("monstree", "Dining Room"), ("keychain", "Keychain")]
)
def test_a_capture_stands_beside_its_column_of_table_2(made: Any, scene: str, column: str) -> None:
    for seed in range(3):
        add(made, scene, seed=seed, lpips=1.3 + seed / 100)
    made.add(scene="another")
    made.add("xrgs", scene="another", factors={"lpips": 0.1})
    (table,) = tables(made)
    assert table.title == f"Beside the paper's Table 2, {column}: {scene}"
    assert signs(table)["LPIPS"] == {"Keychain": "confirmed", "Dining Room": "refuted"}[column]


@pytest.mark.slow
def test_other_scenes_labels_or_bases_have_no_table(made: Any) -> None:
    for scene in SCENES:
        add(made, scene, "consistency")
    assert tables(made) == []
    add(made, SCENES[0], "xrgs", seed=1)
    assert tables(made, against="consistency") == []
    assert why_no_table(["consistency", "xrgs"], SCENES) == ""
    add(made, "garden")
    assert tables(made) == []
    why = why_no_table(["consistency", "xrgs"], [*SCENES, "garden"])
    assert "have scenes outside it: garden. " in why
    assert f"--scenes {' '.join(sorted(SCENES))}`" in why
    assert why_no_table(["consistency"], [*SCENES, "garden"]) == ""  # no full XR-GS
    assert why_no_table(["xrgs"], ["garden"]) == ""


BY_TEXTURE = ("room", "fern", "trex")  # from the flattest to the most textured, as drawn below
TEXTURE_CONTEXTS = {"": Context(("500 steps",), ("a machine",))}


def draw(made: Any, scene: str, amplitude: int) -> None:
    """Give both scored photographs of a scene stripes of this amplitude, in steps of 1 / 255."""
    for view in ("IMG_001", "IMG_009"):
        image = np.full((20, 30, 3), 100, np.uint8)
        image[:, ::2] += np.uint8(amplitude)
        variant = made.rows[-1]["variant_id"]
        folder = made.store.path / "variants" / variant / "images" / "test"
        folder.mkdir(parents=True, exist_ok=True)
        Image.fromarray(image).save(folder / f"{view}.png")


def add_scenes(made: Any, scenes: tuple[str, ...] = BY_TEXTURE) -> None:
    """Ablation `a` gains 1 dB in the flattest scene, 2 dB in the next, and so on."""
    for place, scene in enumerate(scenes, 1):
        made.add(scene=scene)
        made.add("a", scene=scene, values={"psnr": 20.0 + place})
        draw(made, scene, 10 * place)


def tables_by_texture(made: Any) -> list[TextTable]:
    sweep = made.read()
    views = with_texture(ReportStore(made.store.path), sweep.cells, sweep.views)
    return texture_tables(compare(sweep.cells, METRICS), views, TEXTURE_CONTEXTS)


def test_scenes_are_in_the_order_of_their_texture(made: Any) -> None:
    add_scenes(made)
    (table,) = tables_by_texture(made)
    assert table.context == "500 steps"
    expected = [f"{scene} ({10 * place / 255:.4f})" for place, scene in enumerate(BY_TEXTURE, 1)]
    assert table.columns == ("Ablation", "Metric", *expected, "rank correlation")
    rows = {row[:2]: row[2:] for row in table.rows}
    assert rows["a", "PSNR, dB"] == ("+1.00 ↑", "+2.00 ↑", "+3.00 ↑", "+1.00")
    assert rows["a", "LPIPS, %"] == ("0.00 =", "0.00 =", "0.00 =", "")
    assert {metric for _, metric in rows} == {"LPIPS, %", "SSIM, %", "PSNR, dB"}


def test_the_table_stays_where_the_photographs_were_removed(made: Any) -> None:
    add_scenes(made)
    before = tables_by_texture(made)
    for row in made.rows:
        trim_variant(made.store.variants, row["variant_id"])
    assert not list(made.store.variants.rglob("*.png"))
    assert tables_by_texture(made) == before


@pytest.mark.slow
def test_the_correlation_is_one_of_ranks(made: Any) -> None:
    gains = (3.0, 0.1, 0.2, 9.0)
    for place, (scene, gain) in enumerate(zip(("aaa", "bbb", "ccc", "ddd"), gains, strict=True)):
        made.add(scene=scene)
        made.add("a", scene=scene, values={"psnr": 20.0 + gain})
        draw(made, scene, 10 + place**3)
    (table,) = tables_by_texture(made)
    assert table.rows[0][-1] == f"{spearmanr(range(4), gains).statistic:+.2f}"


@pytest.mark.parametrize(("damage", "left"), [("missing", BY_TEXTURE), ("malformed", ())])
def test_scenes_without_photographs_are_left_out(
    made: Any, damage: str, left: tuple[str, ...]
) -> None:
    """Two scenes that are left have no table."""
    add_scenes(made, (*BY_TEXTURE[: 3 if left else 2], "horn"))
    images = made.store.path / "variants" / made.rows[-1]["variant_id"] / "images" / "test"
    for file in images.iterdir():
        file.unlink() if damage == "missing" else file.write_bytes(b"no PNG")
    columns = [column for table in tables_by_texture(made) for column in table.columns]
    assert not any("horn" in column for column in columns)
    assert len(columns) == (3 + len(left) if left else 0)


@pytest.mark.slow
def test_the_texture_of_each_view_is_in_views_csv_and_the_table_on_the_page(
    made: Any, tmp_path: Path
) -> None:
    add_scenes(made)
    made.write()
    folder = build(made.store.path, out=tmp_path / "report", pictures=[]).folder
    with (folder / "views.csv").open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    found = sorted({float(row["texture"]) for row in rows})
    assert found == pytest.approx([10 * place / 255 for place in range(1, 4)])
    assert all(after > before for before, after in pairwise(found))
    title = "Change from baseline by the texture of the scene"
    assert title in (folder / "table.md").read_text()
    assert title in (folder / "report.html").read_text()
