"""The paper's tables beside a comparison's own changes."""

from typing import Any

import pytest

from xrgs.evaluation.metrics import METRICS
from xrgs.report.compare import compare
from xrgs.report.context import Context
from xrgs.report.page import build
from xrgs.report.paper import paper_tables
from xrgs.runtime.text import TextTable

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


def test_two_values_leave_a_sign_open(made: Any) -> None:
    for scene in SCENES[:2]:
        add(made, scene, gaussians=0.3)
    (table,) = tables(made)
    assert signs(table)["Gaussians"] == "open"


def test_each_reading_of_full_xr_gs_has_its_rows(made: Any) -> None:
    for scene in SCENES:
        made.add(scene=scene)
        for label in ("consistency", "xrgs_per_class", "xrgs"):
            made.add(label, scene=scene)
    (table,) = tables(made)
    assert list(dict.fromkeys(row[0] for row in table.rows)) == ["xrgs", "xrgs_per_class"]


@pytest.mark.parametrize(
    ("scene", "column"), [("reichstag", "Dining Room"), ("keychain", "Keychain")]
)
def test_a_capture_stands_beside_its_column_of_table_2(made: Any, scene: str, column: str) -> None:
    for seed in range(3):
        add(made, scene, seed=seed, lpips=1.3 + seed / 100)
    made.add(scene="another")
    made.add("xrgs", scene="another", factors={"lpips": 0.1})
    (table,) = tables(made)
    assert table.title == f"Beside the paper's Table 2, {column}: {scene}"
    assert signs(table)["LPIPS"] == {"Keychain": "confirmed", "Dining Room": "refuted"}[column]


def test_other_scenes_labels_or_bases_have_no_table(made: Any) -> None:
    for scene in SCENES:
        add(made, scene, "consistency")
    assert tables(made) == []
    add(made, SCENES[0], "xrgs", seed=1)
    assert tables(made, against="consistency") == []
    add(made, "garden")
    assert tables(made) == []


def test_the_page_has_the_table_once(made: Any) -> None:
    for scene in SCENES:
        add(made, scene, gaussians=0.3)
    made.write()
    report = build(made.store.path, pictures=[])
    title = "Beside the paper's Table 1: mean over 3 scenes"
    assert report.text.count(title) == 1
    assert (report.folder / "table.md").read_text().count(title) == 1
