"""The table of how much of the gap to all_hr each ablation closes."""

from typing import Any

from xrgs.evaluation.metrics import METRICS
from xrgs.report.compare import Comparison, compare
from xrgs.report.context import Context
from xrgs.report.gap import gap_tables
from xrgs.report.page import build
from xrgs.report.tables import Tables
from xrgs.runtime.text import TextTable

CONTEXTS = {"": Context(("500 steps",), ("a machine",))}


def compared(made: Any) -> Comparison:
    return compare(made.read().cells, METRICS)


def add(made: Any, label: str, scene: str, psnr: float, **more: Any) -> None:
    made.add(label, scene=scene, values={"psnr": psnr}, **more)


def table(made: Any) -> TextTable:
    (one,) = gap_tables(compared(made), CONTEXTS)
    return one


def add_two_scenes(made: Any) -> None:
    """In fern 2 dB are lost, of which `a` regains 1 and `b` loses 1 more; in room none are."""
    for scene, top in (("fern", 22.0), ("room", 19.0)):
        add(made, "baseline", scene, 20.0)
        add(made, "a", scene, 21.0)
        add(made, "b", scene, 19.0)
        add(made, "all_hr", scene, top)


def test_a_row_has_the_share_of_each_scene_and_the_mean(made: Any) -> None:
    add_two_scenes(made)
    built = table(made)
    assert built.title == "Share of the gap from baseline to all_hr that is closed, %"
    assert built.columns == ("Ablation", "Metric", "fern", "room", "mean")
    rows = {row[:2]: row[2:] for row in built.rows}
    assert rows["a", "PSNR"] == ("+50.00", "n/a", "+50.00 (1 of 2)")
    assert rows["b", "PSNR"] == ("-50.00", "n/a", "-50.00 (1 of 2)")
    assert {label for label, _ in rows} == {"a", "b"}
    assert {metric for _, metric in rows} == {"LPIPS", "SSIM", "PSNR"}
    assert len(built.align) == len(built.columns)


def test_why_there_is_no_share_is_said_once_for_all_ablations(made: Any) -> None:
    add_two_scenes(made)
    notes = table(made).notes
    assert notes.count("PSNR, room: n/a (all_hr is worse)") == 1
    assert notes.count("SSIM, fern: n/a (all_hr has the same value)") == 1


def test_the_table_says_how_its_scores_were_made(made: Any) -> None:
    add_two_scenes(made)
    assert table(made).context == "500 steps"


def test_an_ablation_alone_without_a_share_is_named(made: Any) -> None:
    add_two_scenes(made)
    made.add("c", scene="fern", values={"psnr": None})
    made.add("c", scene="room", state="failed")
    built = table(made)
    assert "PSNR, fern: n/a (not measured): c" in built.notes
    assert {row[:2]: row[2:4] for row in built.rows}["c", "PSNR"] == ("n/a", "missing")


def test_the_interval_is_over_scenes_or_replicates(made: Any) -> None:
    for seed, psnr in enumerate((21.0, 20.5)):
        for label, value in (("baseline", 20.0), ("a", psnr), ("all_hr", 22.0)):
            add(made, label, "fern", value, seed=seed)
    assert "interval: Student's t over the replicates" in table(made).notes
    for label, value in (("baseline", 20.0), ("a", 21.0), ("all_hr", 22.0)):
        add(made, label, "room", value)
    assert "interval: Student's t over the scenes' means" in table(made).notes


def test_a_sweep_without_all_hr_or_with_nothing_else_has_no_table(made: Any) -> None:
    made.add()
    assert gap_tables(compared(made), CONTEXTS) == []
    made.add("all_hr")
    assert gap_tables(compared(made), CONTEXTS) == []


def test_the_share_is_in_every_file_of_tables(made: Any) -> None:
    add_two_scenes(made)
    report = build(made.store.path, made.write())
    title = "Share of the gap from baseline to all\\_hr that is closed"
    for name in ("table.md", "table.tex"):
        assert title in (report.folder / name).read_text()
    assert title.replace("\\", "") in report.text
    long = Tables(compared(made)).long()
    shares = long[(long["metric"] == "psnr") & (long["label"] == "a")]
    by_scene = shares.set_index("scene")["gap_closed_percent"]
    assert by_scene[["", "fern"]].tolist() == [50.0, 50.0]
    assert shares.set_index("scene")["gap_why"]["room"] == "all_hr is worse"
    assert long[long["metric"] == "gaussians"]["gap_closed_percent"].isna().all()
