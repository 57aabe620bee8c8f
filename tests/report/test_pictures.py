"""How changes depend on a setting: which labels are one curve, and what is drawn of them."""

import math
from pathlib import Path
from typing import Any

import pytest

from xrgs.evaluation.metrics import METRICS
from xrgs.report import pictures
from xrgs.report.compare import compare
from xrgs.report.page import build
from xrgs.report.pictures import sensitivities

WEIGHTS = {"0.05": 21.0, "0.2": 22.0, "1": 19.0}


def add_weights(made: Any, scenes: tuple[str, ...] = ("fern", "room"), values: Any = None) -> None:
    """Each weight has its own PSNR, and twice the baseline's Gaussians."""
    for scene in scenes:
        made.add(scene=scene, values={"psnr": 20.0, "gaussians": 100})
        for weight, psnr in (values or WEIGHTS).items():
            label = f"consistency.weight={weight}"
            made.add(label, scene=scene, values={"psnr": psnr, "gaussians": 200})


def found(made: Any) -> dict[str, Any]:
    return sensitivities(compare(made.read().cells, METRICS))


def test_changes_are_in_the_order_of_the_values_at_each_level(made: Any) -> None:
    add_weights(made)
    made.add("consistency.weight=3", state="failed")  # it is left out
    ((key, changes),) = found(made).items()
    assert key == "consistency.weight"
    assert set(changes["series"]) == {""}
    gaussians = changes.loc[changes["metric"] == "gaussians", "change"]
    assert gaussians.tolist() == pytest.approx([100.0] * len(gaussians))
    for level, scenes in (("pair", 2), ("scene", 2), ("mean", 1)):
        rows = changes[(changes["level"] == level) & (changes["metric"] == "psnr")]
        points = list(zip(rows["value"], rows["change"], strict=True))
        assert points == [
            (value, pytest.approx(change))
            for value, change in ((0.05, 1.0), (0.2, 2.0), (1.0, -1.0))
            for _ in range(scenes)
        ]


def test_two_settings_are_one_curve_for_each_value_of_the_other(made: Any) -> None:
    made.add()
    for grow in (1, 2, 4):
        for prune in (1, 2):
            made.add(f"densify densify.lr_grow={grow} densify.lr_prune={prune}")
    by_key = found(made)
    assert list(by_key) == ["densify.lr_grow"]  # lr_prune has two values
    assert set(by_key["densify.lr_grow"]["series"]) == {
        "densify densify.lr_prune=1",
        "densify densify.lr_prune=2",
    }


@pytest.mark.parametrize(
    "labels",
    [
        ("a", "b", "c"),
        ("a.b=1", "a.b=2"),
        ("a.b=1", "a.b=nan", "a.b=inf"),
        ("a.b=1", "a.b=1.0", "a.b=2"),
        ("a.b=1", "c a.b=2", "d a.b=3"),
    ],
)
def test_names_and_fewer_than_three_values_are_no_curve(made: Any, labels: tuple[str, ...]) -> None:
    made.add()
    for label in labels:
        made.add(label)
    assert found(made) == {}


def test_a_swept_condition_is_a_setting_of_each_ablation(made: Any) -> None:
    for factor in (2, 3, 8):
        for share in (0.1, 0.5):
            condition = f"variant.factor={factor} variant.hr_fraction={share}"
            changes = {"baseline": 0.0, "plus": factor, "lean": share}
            for label, change in changes.items():
                made.add(label, condition=condition, values={"psnr": 20.0 + change})
    ((key, rows),) = found(made).items()
    assert key == "variant.factor"  # hr_fraction has two values
    means = rows[(rows["level"] == "mean") & (rows["metric"] == "psnr")]
    curves = {name: list(curve["change"]) for name, curve in means.groupby("series")}
    assert curves == {
        "lean variant.hr_fraction=0.1": pytest.approx([0.1] * 3),
        "lean variant.hr_fraction=0.5": pytest.approx([0.5] * 3),
        "plus variant.hr_fraction=0.1": pytest.approx([2, 3, 8]),
        "plus variant.hr_fraction=0.5": pytest.approx([2, 3, 8]),
    }


@pytest.mark.slow
def test_the_report_has_the_figure_where_there_are_three_values(made: Any, tmp_path: Path) -> None:
    add_weights(made)
    made.write()
    pictures = ["sensitivity-consistency.weight"]
    folder = build(made.store.path, out=tmp_path / "with", pictures=pictures).folder
    assert (folder / "figures" / "sensitivity-consistency.weight.png").exists()
    assert "Change from baseline over consistency.weight" in (folder / "table.md").read_text()


def test_of_more_curves_than_colours_each_ablation_has_its_own_figure(made: Any) -> None:
    for other in range(4):
        for value in (1, 2, 3):
            for label in ("baseline", "plus", "lean"):
                made.add(label, condition=f"a.b={value} c.d=x{other}")
    drawings = pictures._sensitivities(compare(made.read().cells, METRICS))
    assert [*drawings] == ["sensitivity-a.b.plus", "sensitivity-a.b.lean"]


def test_more_curves_of_one_ablation_than_colours_are_not_drawn_and_said(made: Any) -> None:
    for other in range(8):
        made.add(condition=f"c.d=x{other}")
        for value in (1, 2, 3):
            made.add(f"a.b={value}", condition=f"c.d=x{other}")
    comparison = compare(made.read().cells, METRICS)
    ((name, drawing),) = pictures._sensitivities(comparison).items()
    assert name == "sensitivity-a.b"
    picture = drawing(Path("nowhere.png"))
    assert (picture.file, picture.why) == (None, "8 curves, and a figure can tell 7 apart")


def test_a_score_that_is_not_known_leaves_out_its_panel(made: Any) -> None:
    add_weights(made, ("fern",), {"1": 21.0, "2": math.nan, "3": 22.0})
    changes = found(made)["consistency.weight"]
    psnr = changes[(changes["metric"] == "psnr") & (changes["level"] == "mean")]
    assert psnr["change"].isna().tolist() == [False, True, False]


@pytest.mark.slow
def test_of_many_pictures_the_first_are_drawn_and_the_rest_said(
    made: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pictures, "_MAX_PICTURES", 1)
    made.add()
    for label in ("a", "b"):
        made.add(label)
    made.write()
    folder = build(made.store.path).folder
    assert [file.stem for file in (folder / "figures").iterdir()] == ["trade-off"]
    said = "No picture of 4 more: only the first 1 are drawn; --pictures NAMES draws others"
    assert said in (folder / "table.md").read_text()
