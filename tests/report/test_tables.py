"""What a number looks like in a table, and what is said of it."""

import csv
import io
import math
from typing import Any

import pytest

from tests.evaluation.test_metrics import MORE_IS_BETTER
from xrgs.evaluation.metrics import METRICS
from xrgs.report.compare import Comparison, compare
from xrgs.report.context import Context
from xrgs.report.page import build
from xrgs.report.tables import Tables
from xrgs.report.writing import ARROWS_NOTE, LACKING_NOTE, percent, scale_note
from xrgs.runtime.text import TextTable

BY_NAME = {metric.name: metric for metric in METRICS}


def tables(made: Any, against: str = "baseline") -> Tables:
    cells = made.read().cells
    return Tables(compare(cells, METRICS, against))


def test_psnr_has_decibels_beside_its_percentage(made: Any) -> None:
    made.add()
    made.add("consistency", factors={"psnr": 0.99})
    table = tables(made).mean("consistency", "")
    rows = {row[0]: row for row in table.rows}
    assert rows["PSNR"] == ("PSNR", "20.00 dB", "19.80 dB", "-1.00 ↓", "-0.20")
    assert rows["SSIM"][4] == ""
    assert table.title == "consistency against baseline: scene fern, seed 0"


def test_one_replicate_has_no_empty_columns_and_says_once_why(made: Any) -> None:
    made.add()
    made.add("consistency", factors={"psnr": 0.99})
    context = {"": Context(("3 steps",))}
    table = Tables(tables(made).comparison, context).mean("consistency", "")
    head = ("Metric", "baseline", "consistency", "change from baseline, %", "dB")
    assert (table.columns, table.align) == (head, "lrrrr")
    assert table.context == "one replicate: no interval; 3 steps"
    assert not any("one replicate" in text for row in table.rows for text in row)
    assert not any(note.startswith(("pairs that", "sd ")) for note in table.notes)


def test_what_has_no_change_says_why_in_a_table_of_one_replicate(made: Any) -> None:
    made.add(values={"gaussians": 0})
    made.add("consistency")
    table = tables(made).mean("consistency", "")
    readings = {row[0]: row[-1] for row in table.rows}
    assert table.columns[-1] == "reading"
    assert readings["Gaussians"] == "n/a: compared with zero"
    assert readings["PSNR"] == ""


def test_a_second_replicate_brings_the_columns_back(made: Any) -> None:
    for seed, factor in enumerate((1.5, 1.2)):
        made.add(seed=seed)
        made.add("consistency", seed=seed, factors={"gaussians": factor})
    table = tables(made).mean("consistency", "")
    assert table.columns[5:] == (
        "95 % interval, %", "pairs that agree", "sd replicates, %", "reading",
    )  # fmt: skip
    assert table.context == ""
    assert any(note.startswith("sd replicates") for note in table.notes)


def test_failed_scenes_are_shown_as_failed(made: Any) -> None:
    made.add()
    made.add("consistency", factors={"gaussians": 0.5})
    made.add_error("leaves")
    made.add_error("leaves", "consistency")
    made.add(scene="room")
    made.add("consistency", scene="room", state="failed")
    built = tables(made)
    table = built.per_scene("consistency", "")
    assert table.columns == ("Metric", "fern", "leaves", "room", "mean")
    rows = {row[0]: [text.strip() for text in row[1:]] for row in table.rows}
    assert rows["Gaussians, %"] == ["-50.00 ↑", "missing", "missing", "-50.00 ↑ (1 of 3)"]
    assert rows["PSNR, dB"] == ["0.00", "missing", "missing", "0.00"]
    assert "1 of 3 scenes" in built.mean("consistency", "").title
    missing = built.missing()
    assert missing is not None
    assert missing.title == "3 of 6 cells gave no number"
    assert ("leaves", "baseline", "", "0", "0", "failed", "leaves: 3 of 24 views registered") in (
        missing.rows
    )


def test_a_long_reason_is_whole_below_the_table(made: Any) -> None:
    """A scene that failed is told what to try, by the names of its photographs."""
    reason = "scene fern failed: " + "try more photographs, " * 40
    for label in ("baseline", "consistency"):
        made.add_error("fern", label)
        made.rows[-1]["error"] = reason
    table = tables(made).missing()
    assert table is not None
    assert [row[-1] for row in table.rows] == ["see (1)"] * 2
    assert table.notes == (f"(1) {reason}",)
    report = build(made.store.path)
    page = (report.folder / "report.html").read_text()
    for text in (report.text, (report.folder / "table.md").read_text(), page):
        assert reason.strip() in text


def test_nothing_missing_is_no_table(made: Any) -> None:
    made.add()
    assert tables(made).missing() is None


@pytest.mark.parametrize(("seeds", "mixed"), [((1, 1), True), ((1, 2), False), ((2, 2), False)])
def test_the_note_on_one_seed_is_for_scenes_that_all_have_one(
    made: Any, seeds: tuple[int, int], mixed: bool
) -> None:
    for scene, count in zip(("fern", "room"), seeds, strict=True):
        for seed in range(count):
            made.add(scene=scene, seed=seed)
            factor = 1.1 + 0.1 * seed + 0.05 * (scene == "room")
            made.add("consistency", scene=scene, seed=seed, factors={"gaussians": factor})
    (note,) = (n for n in tables(made).mean("consistency", "").notes if n.startswith("interval"))
    assert note.startswith("interval: Student's t over the scenes' means")
    assert (
        note.endswith("; with one replicate, differences of runs and of scenes are mixed") == mixed
    )


@pytest.mark.parametrize(
    ("count", "text"), [(1, "seed 0"), (8, "seeds 0, 1, 2, 3, 4, 5, 6, 7"), (9, "9 replicates")]
)
def test_a_title_lists_up_to_eight_seeds(made: Any, count: int, text: str) -> None:
    for seed in range(count):
        made.add(seed=seed)
        made.add("consistency", seed=seed)
    title = tables(made).mean("consistency", "").title
    assert title == f"consistency against baseline: scene fern, {text}"


def test_a_title_names_replicates_that_have_variants_of_their_own(made: Any) -> None:
    for seed in range(3):
        made.add(draw=seed, seed=seed, variant=f"v{seed}")
        made.add("consistency", draw=seed, seed=seed, variant=f"v{seed}")
    made.add(draw=3, variant="v3", state="failed")
    built = tables(made)
    title = built.mean("consistency", "").title
    assert title.endswith("scene fern, replicates 0/0, 1/1, 2/2 (variant.seed/seed)")
    missing = built.missing()
    assert missing is not None
    assert missing.rows[0][3:5] == ("3", "0")


def test_pairs_that_agree_stand_beside_the_interval(made: Any) -> None:
    for seed, factor in enumerate((1.5, 1.2, 0.9)):
        made.add(seed=seed)
        made.add("consistency", seed=seed, factors={"gaussians": factor})
    table = tables(made).mean("consistency", "")
    column = table.columns.index("pairs that agree")
    assert table.columns[column - 1] == "95 % interval, %"
    assert {row[0]: row[column] for row in table.rows}["Gaussians"] == "2 of 3"
    long = tables(made).long()
    rows = long[long["metric"] == "gaussians"]
    assert rows[["agree", "pairs"]].to_numpy().tolist() == [[2, 3], [2, 3]]


def test_several_ablations_stand_beside_each_other(made: Any) -> None:
    made.add()
    made.add("consistency", factors={"gaussians": 0.5})
    made.add("loss_weighting", state="failed")
    built = tables(made)
    (table,) = built.overviews()
    assert table.columns == ("Metric", "consistency vs baseline", "loss_weighting vs baseline")
    assert ("Gaussians", "-50.00 ↑", "missing") in table.rows
    assert table.title == "Change from baseline, %, mean over scenes"
    assert table.align == "lrr"
    assert table.notes == (ARROWS_NOTE, scale_note(built.comparison))
    assert "Gaussians" in table.notes[1].partition("of the change in %")[0]
    assert "PSNR" in table.notes[1].partition("of the change in %")[2]


def test_an_overview_of_each_condition_names_it(made: Any) -> None:
    for condition in ("train.steps=10", "train.steps=20"):
        made.add(condition=condition)
        for label in ("consistency", "loss_weighting"):
            made.add(label, condition=condition)
    titles = [table.title for table in tables(made).overviews()]
    assert len(titles) == 2
    for title, condition in zip(titles, ("train.steps=10", "train.steps=20"), strict=True):
        assert title.startswith("Change from baseline, %, mean over scenes")
        assert condition in title


def test_one_ablation_needs_no_overview(made: Any) -> None:
    made.add()
    made.add("consistency")
    assert tables(made).overviews() == []


def test_values_side_by_side(made: Any) -> None:
    for seed, size in enumerate((1.0, 3.0)):
        made.add(seed=seed, factors={"gaussians": size})
        made.add("consistency", seed=seed, factors={"gaussians": size / 2})
    table = tables(made).values("")
    assert table.columns == ("Scene", "Metric", "baseline", "consistency")
    assert ("fern", "Gaussians", "10,000", "5,000") in table.rows


def test_pairs_left_out_of_a_mean_are_named(made: Any) -> None:
    made.add(values={"gaussians": 0})
    made.add("consistency")
    made.add(scene="room")
    made.add("consistency", scene="room", factors={"gaussians": 2.0})
    table = tables(made).mean("consistency", "")
    assert "Gaussians: pairs left out (compared with zero)" in table.notes
    assert next(row for row in table.rows if row[0] == "Gaussians")[3] == "+100.00 ↓ (1 of 2)"


def test_the_long_table_has_every_number_at_full_precision(made: Any) -> None:
    for scene, factor in (("fern", 1 / 3), ("room", 1 / 7)):
        made.add(scene=scene)
        made.add("consistency", scene=scene, factors={"training_time_s": factor})
    text = tables(made).long().to_csv(index=False)
    rows = [r for r in csv.DictReader(io.StringIO(text)) if r["metric"] == "training_time_s"]
    assert [row["level"] for row in rows] == ["mean", "scene", "scene"]
    assert [row["scene"] for row in rows] == ["", "fern", "room"]
    fern = 100 * (1 / 3 - 1)
    assert float(rows[1]["change_percent"]) == pytest.approx(fern, rel=1e-14)
    mean = 100 * (math.sqrt(1 / 21) - 1)
    assert float(rows[0]["change_percent"]) == pytest.approx(mean, rel=1e-14)
    assert rows[1]["printed"] == percent(fern, BY_NAME["training_time_s"]) == "-66.67 ↑"
    assert rows[1]["reading"] == "one replicate: no interval"
    assert rows[0]["n_of"] == "scenes"


def test_cells_without_results_are_listed_with_why(made: Any) -> None:
    made.add()
    made.add("consistency", state="failed")
    table = tables(made).missing()
    assert table is not None
    assert table.title == "1 of 2 cells gave no number"
    assert table.columns == (
        *("Scene", "Label", "Condition", "variant.seed", "seed", "State", "Reason"),
    )
    assert table.align == "lllrrll"
    assert [row[:6] for row in table.rows] == [("fern", "consistency", "", "0", "0", "failed")]


def test_tables_of_a_condition_name_it_and_align_numbers_to_the_right(made: Any) -> None:
    for condition, factor in (("train.steps=10", 2.0), ("train.steps=20", 3.0)):
        for scene in ("fern", "horns"):
            made.add(scene=scene, condition=condition, values={"gaussians": 10 * factor})
            made.add("consistency", scene=scene, condition=condition, state="failed")
    built = tables(made)
    values = built.values("train.steps=20")
    assert values.title == "Values, means over the replicates that are done (train.steps=20)"
    assert values.align == "llrr"
    rows = {row[:2]: row[2:] for row in values.rows}
    assert rows["fern", "Gaussians"] == ("30", "missing")
    by_scene = built.per_scene("consistency", "train.steps=20")
    assert by_scene.title == "consistency: change from baseline, scene by scene (train.steps=20)"
    assert by_scene.align == "lrrr"
    assert by_scene.notes == (ARROWS_NOTE, scale_note(built.comparison))


def test_the_long_table_has_each_metrics_unit_and_direction(made: Any) -> None:
    made.add()
    made.add("consistency", factors={"psnr": 0.5})
    long = tables(made).long()
    for row in long.to_dict("records"):
        metric = BY_NAME[row["metric"]]
        assert row["metric_unit"] == metric.unit
        assert row["higher_is_better"] == MORE_IS_BETTER[row["metric"]]
        assert row["printed"] == row["printed"].rstrip()
    assert set(long["scene"]) == {"", "fern"}
    (mean,) = long[(long["level"] == "mean") & (long["metric"] == "psnr")].to_dict("records")
    assert (mean["printed"], mean["scene"]) == ("-50.00 ↓", "")


def add_three(made: Any, *labels: str) -> None:
    """Three scenes in which the n-th label has n % more PSNR, give or take a little."""
    for scene, noise in (("fern", -0.001), ("room", 0.0), ("trex", 0.001)):
        made.add(scene=scene)
        for number, label in enumerate(labels, start=1):
            made.add(label, scene=scene, factors={"psnr": 1 + number / 100 + noise})


def test_q_and_its_star_stand_in_the_tables(made: Any) -> None:
    add_three(made, "a", "b")
    built = tables(made)
    (overview,) = built.overviews()
    assert next(row for row in overview.rows if row[0] == "PSNR")[1:] == ("+1.00 ↑ *", "+2.00 ↑ *")
    assert next(row for row in overview.rows if row[0] == "SSIM")[1:] == ("0.00 =", "0.00 =")
    note = "q: Benjamini and Hochberg's rate of false discoveries over 18 t-tests, of all ablations"
    assert any(text.startswith(note) for text in overview.notes)
    mean = built.mean("a", "")
    row = dict(zip(mean.columns, next(r for r in mean.rows if r[0] == "PSNR"), strict=True))
    # t = 0.01 / (0.001 / sqrt(3)) with 2 degrees of freedom: p = 0.00332, the larger of two in 18.
    assert row["q"] == "0.030 *"
    assert row["reading"] == "better"
    assert row["sd scenes, %"] == "0.10"
    assert "sd replicates, %" not in row  # each scene has one


def test_two_scenes_allow_no_verdict_and_no_star(made: Any) -> None:
    for scene, factor in (("fern", 1.5), ("room", 1.5001)):
        made.add(scene=scene)
        made.add("a", scene=scene, factors={"psnr": factor})
    table = tables(made).mean("a", "")
    row = dict(zip(table.columns, next(r for r in table.rows if r[0] == "PSNR"), strict=True))
    assert row["reading"] == "two values: no verdict"
    assert "q" not in row


def test_a_mean_over_fewer_scenes_is_marked(made: Any) -> None:
    add_three(made, "a", "b")
    for label in ("baseline", "a", "b"):
        made.add(label, scene="leaves", values={"lpips": None if label == "b" else 0.25})
    built = tables(made)
    (overview,) = built.overviews()
    rows = {row[0]: row[1:] for row in overview.rows}
    assert rows["LPIPS"] == ("0.00 =", "0.00 = (3 of 4)")
    assert rows["SSIM"] == ("0.00 =", "0.00 =")
    assert LACKING_NOTE in overview.notes
    assert LACKING_NOTE in built.per_scene("b", "").notes
    assert LACKING_NOTE not in built.per_scene("a", "").notes


def test_every_title_and_column_names_the_base(made: Any) -> None:
    add_three(made, "plus", "b")
    built = tables(made, "plus")
    (overview,) = built.overviews()
    assert overview.title == "Change from plus, %, mean over scenes"
    assert overview.columns == ("Metric", "baseline vs plus", "b vs plus")
    assert next(row for row in overview.rows if row[0] == "PSNR")[1] == "-0.99 ↓ *"
    mean = built.mean("b", "")
    assert mean.title == "b against plus: 3 scenes, seed 0"
    assert mean.columns[1:4] == ("plus", "b", "change from plus, %")
    assert built.per_scene("b", "").title == "b: change from plus, scene by scene"
    assert set(built.long()["against"]) == {"plus"}


def test_an_ablation_that_is_the_baseline_is_said_to_change_nothing(made: Any) -> None:
    made.add()
    made.rows.append(made.rows[0] | {"label": "idle"})
    made.add("consistency", factors={"psnr": 0.99})
    built = tables(made)
    table = built.mean("idle", "")
    assert table.rows == (("idle changes nothing: its cells are the cells of baseline",),)
    assert built.per_scene("idle", "").rows == ()
    (overview,) = built.overviews()
    assert {row[1] for row in overview.rows} == {"="}
    assert "idle changes nothing: its cells are the cells of baseline" in overview.notes


@pytest.mark.parametrize(("metric", "same"), [("training_time_s", True), ("gaussians", False)])
def test_equal_results_change_nothing_and_times_do_not_count(
    made: Any, metric: str, same: bool
) -> None:
    made.add()
    made.add("idle", factors={metric: 1.1})
    why = tables(made).unchanged("idle", "")
    assert bool(why) == same
    assert why in {"", "changes nothing: its scores, counts and amounts of work are those of"
                   " baseline"}  # fmt: skip


def test_scores_stand_by_method_and_scene_with_the_best_in_bold(made: Any) -> None:
    for scene in ("fern", "room"):
        made.add(scene=scene)
        made.add("consistency", scene=scene, values={"psnr": 21.0, "ssim": 0.7, "lpips": None})
    made.add("plus", values={"psnr": 21.0, "ssim": 0.9, "lpips": 0.3})
    table = tables(made).scores("")
    assert table.columns == ("Method", *("PSNR ↑", "SSIM ↑", "LPIPS ↓") * 3)
    assert table.spans == (("", 1), ("fern", 3), ("room", 3), ("mean", 3))
    assert table.rows == (
        ("baseline", *("20.00", "0.800", "0.250") * 3),
        ("consistency", *("21.00", "0.700", "n/a") * 3),
        ("plus", "21.00", "0.900", "0.300", *("n/a",) * 6),
    )
    bold = {(table.rows[row][0], column) for row, column in table.best}
    assert bold == {
        *(("consistency", 1), ("plus", 1), ("plus", 2), ("baseline", 3)),  # fern
        *(("consistency", 4), ("baseline", 5)),  # room; only one has LPIPS
        *(("consistency", 7), ("baseline", 8)),  # mean
    }


def test_every_table_with_arrows_has_their_legend_and_its_context(made: Any) -> None:
    for scene in ("fern", "room"):
        made.add(scene=scene)
        made.add("consistency", scene=scene, factors={"gaussians": 0.5})
        made.add("plus", scene=scene, factors={"gaussians": 0.6})
    comparison = tables(made).comparison
    built = Tables(comparison, {"": Context(("3 steps",), ("a machine",), ("Caution: few",))})
    changes = [*built.overviews(), built.mean("plus", ""), built.per_scene("plus", "")]
    for table in changes:
        assert any("↑" in text for row in table.rows for text in row)
        assert ARROWS_NOTE in table.notes
        assert table.context == "3 steps; a machine"
    assert "Caution: few" in built.overviews()[0].notes
    assert "Caution: few" in built.mean("plus", "").notes
    assert built.scores("").context == "3 steps"  # it has no times
    assert "Caution: few" in built.scores("").notes


GAP_CONTEXTS = {"": Context(("500 steps",), ("a machine",))}


def compared(made: Any) -> Comparison:
    return compare(made.read().cells, METRICS)


def add_psnr(made: Any, label: str, scene: str, psnr: float, **more: Any) -> None:
    made.add(label, scene=scene, values={"psnr": psnr}, **more)


def gap_table(made: Any) -> TextTable:
    (one,) = Tables(compared(made), GAP_CONTEXTS).gaps()
    return one


def add_two_scenes(made: Any) -> None:
    """In fern 2 dB are lost, of which `a` regains 1 and `b` loses 1 more; in room none are."""
    for scene, top in (("fern", 22.0), ("room", 19.0)):
        add_psnr(made, "baseline", scene, 20.0)
        add_psnr(made, "a", scene, 21.0)
        add_psnr(made, "b", scene, 19.0)
        add_psnr(made, "all_hr", scene, top)


def test_a_row_has_the_share_of_each_scene_and_the_mean(made: Any) -> None:
    add_two_scenes(made)
    built = gap_table(made)
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
    notes = gap_table(made).notes
    assert notes.count("PSNR, room: n/a (all_hr is worse)") == 1
    assert notes.count("SSIM, fern: n/a (all_hr has the same value)") == 1


def test_the_table_says_how_its_scores_were_made(made: Any) -> None:
    add_two_scenes(made)
    assert gap_table(made).context == "500 steps"


def test_an_ablation_alone_without_a_share_is_named(made: Any) -> None:
    add_two_scenes(made)
    made.add("c", scene="fern", values={"psnr": None})
    made.add("c", scene="room", state="failed")
    built = gap_table(made)
    assert "PSNR, fern: n/a (not measured): c" in built.notes
    assert {row[:2]: row[2:4] for row in built.rows}["c", "PSNR"] == ("n/a", "missing")


def test_the_interval_is_over_scenes_or_replicates(made: Any) -> None:
    for seed, psnr in enumerate((21.0, 20.5)):
        for label, value in (("baseline", 20.0), ("a", psnr), ("all_hr", 22.0)):
            add_psnr(made, label, "fern", value, seed=seed)
    assert "interval: Student's t over the replicates" in gap_table(made).notes
    for label, value in (("baseline", 20.0), ("a", 21.0), ("all_hr", 22.0)):
        add_psnr(made, label, "room", value)
    assert "interval: Student's t over the scenes' means" in gap_table(made).notes


def test_a_sweep_without_all_hr_or_with_nothing_else_has_no_table(made: Any) -> None:
    made.add()
    assert Tables(compared(made)).gaps() == []
    made.add("all_hr")
    assert Tables(compared(made)).gaps() == []


def test_the_share_is_in_every_file_of_tables(made: Any) -> None:
    add_two_scenes(made)
    report = build(made.store.path, made.write(), pictures=[])
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
