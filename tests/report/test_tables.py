"""What a number looks like in a table, and what is said of it."""

import csv
import io
import math
from typing import Any

import pytest
from scipy import stats

from tests.evaluation.test_metrics import MORE_IS_BETTER
from xrgs.evaluation.metrics import METRICS
from xrgs.report.compare import Comparison, Design, compare
from xrgs.report.context import Context
from xrgs.report.page import build
from xrgs.report.tables import Tables
from xrgs.report.writing import legend, pointed
from xrgs.runtime.text import TextTable, to_text

BY_NAME = {metric.name: metric for metric in METRICS}


def tables(made: Any, against: str = "baseline", design: Design | None = None) -> Tables:
    cells = made.read().cells
    return Tables(compare(cells, METRICS, against, design))


def rows_of(table: TextTable) -> dict[str, dict[str, str]]:
    """The rows by their first cell, each by the table's columns."""
    return {row[0]: dict(zip(table.columns, row, strict=True)) for row in table.rows}


def meanings(built: Tables) -> dict[str, str]:
    """The legend of the overviews and the means of all ablations."""
    comparison = built.comparison
    shown = [*built.overviews(), *(built.mean(*group) for group in comparison.groups)]
    return {row[0]: row[1] for row in legend(comparison, shown).rows}


def test_one_replicate_has_no_empty_columns_and_says_once_why(made: Any) -> None:
    made.add()
    made.add("consistency", factors={"psnr": 0.99, "lpips": 0.5})
    context = {"": Context(("3 steps",))}
    table = Tables(tables(made).comparison, context).mean("consistency", "")
    head = ("Metric", "baseline", "consistency", "change")
    assert (table.columns, table.align) == (head, "lrrr")
    assert table.title == "consistency against baseline: scene fern, seed 0"
    assert table.context == "one replicate: no interval; 3 steps"
    rows = {row[0]: row for row in table.rows}
    assert rows["PSNR"] == ("PSNR", "20.00 dB", "19.80 dB", "-0.20 dB ↓")
    assert rows["LPIPS"] == ("LPIPS", "0.2500", "0.1250", "-50.00 % ↑")
    assert table.notes == ()


def test_what_has_no_change_says_why_in_a_table_of_one_replicate(made: Any) -> None:
    made.add(values={"gaussians": 0})
    made.add("consistency")
    rows = rows_of(tables(made).mean("consistency", ""))
    assert rows["Gaussians"]["verdict"] == "n/a: not above zero"
    assert rows["PSNR"]["verdict"] == ""


def test_a_second_replicate_brings_columns_and_a_third_one_verdicts(made: Any) -> None:
    for seed, factor in enumerate((1.5, 1.2, 1.3)):
        made.add(seed=seed)
        made.add("consistency", seed=seed, factors={"gaussians": factor})
        if seed == 1:
            table = tables(made).mean("consistency", "")
            assert table.columns[4:] == ("95 % interval", "same sign (p)", "verdict")
            assert table.context == ""
            assert rows_of(table)["Gaussians"]["verdict"] == "not shown"
    table = tables(made).mean("consistency", "")
    assert table.columns[4:] == ("95 % interval", "same sign (p)", "q", "verdict")
    rows = rows_of(table)
    assert rows["Gaussians"]["verdict"] == "worse"
    assert rows["PSNR"]["verdict"] == "equivalent"
    assert rows["SSIM"]["verdict"] == "descriptive"
    assert [row[0] for row in table.rows][:6] == [
        *("PSNR", "PSNR (pooled)", "PSNR (worst view)", "LPIPS"),
        *("Alpha evaluations", "Gaussians"),
    ]


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
    assert rows["PSNR, dB"] == ["0.00 =", "missing", "missing", "0.00 = (1 of 3)"]
    assert "1 of 3 scenes" in built.mean("consistency", "").title
    missing = built.missing()
    assert missing is not None
    assert missing.title == "3 of 6 cells gave no number"
    keys = ("Scene", "Label", "Condition", "variant.seed", "seed", "State", "Reason")
    assert (missing.columns, missing.align) == (keys, "lllrrll")
    reason = "leaves: 3 of 24 views registered"
    assert ("leaves", "baseline", "", "0", "0", "not placed", reason) in missing.rows


@pytest.mark.slow
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


@pytest.mark.parametrize(("seeds", "mixed"), [((1, 1), True), ((1, 2), False), ((2, 2), False)])
def test_the_note_on_one_replicate_is_for_scenes_that_all_have_one(
    made: Any, seeds: tuple[int, int], mixed: bool
) -> None:
    for scene, count in zip(("fern", "room"), seeds, strict=True):
        for seed in range(count):
            made.add(scene=scene, seed=seed)
            factor = 1.1 + 0.1 * seed + 0.05 * (scene == "room")
            made.add("consistency", scene=scene, seed=seed, factors={"gaussians": factor})
    note = "one replicate a scene: differences of runs and of scenes are mixed"
    assert (note in tables(made).mean("consistency", "").notes) == mixed


def test_a_title_lists_up_to_eight_seeds(made: Any) -> None:
    for seed in range(9):
        made.add(seed=seed)
        made.add("consistency", seed=seed)
        if seed == 7:
            built = tables(made)
            assert built.missing() is None
            assert built.mean("consistency", "").title.endswith("seeds 0, 1, 2, 3, 4, 5, 6, 7")
    title = tables(made).mean("consistency", "").title
    assert title == "consistency against baseline: scene fern, 9 replicates"


def test_pairs_left_out_of_a_mean_are_named(made: Any) -> None:
    made.add(values={"gaussians": 0})
    made.add("consistency")
    made.add(scene="room")
    made.add("consistency", scene="room", factors={"gaussians": 2.0})
    table = tables(made).mean("consistency", "")
    assert "Gaussians: pairs left out (not above zero)" in table.notes
    assert rows_of(table)["Gaussians"]["change"] == "+100.00 % ↓ (1 of 2)"


def test_the_long_table_has_every_number_at_full_precision(made: Any) -> None:
    for scene, factor in (("fern", 1 / 3), ("room", 1 / 7)):
        made.add(scene=scene)
        made.add("consistency", scene=scene, factors={"training_time_s": factor})
    long = tables(made).long()
    for row in long.to_dict("records"):
        metric = BY_NAME[row["metric"]]
        assert row["metric_unit"] == metric.unit
        assert row["higher_is_better"] == MORE_IS_BETTER[row["metric"]]
        assert row["printed"] == row["printed"].rstrip()
    (mean,) = long[(long["level"] == "mean") & (long["metric"] == "psnr")].to_dict("records")
    assert (mean["printed"], mean["change_unit"], mean["outcome"]) == ("0.00 =", "dB", True)
    text = long.to_csv(index=False)
    rows = [r for r in csv.DictReader(io.StringIO(text)) if r["metric"] == "training_time_s"]
    assert [row["level"] for row in rows] == ["mean", "scene", "scene"]
    assert [row["scene"] for row in rows] == ["", "fern", "room"]
    fern = 100 * (1 / 3 - 1)
    assert float(rows[1]["change"]) == pytest.approx(fern, rel=1e-14)
    of_both = 100 * (math.sqrt(1 / 21) - 1)
    assert float(rows[0]["change"]) == pytest.approx(of_both, rel=1e-14)
    assert rows[1]["printed"] == pointed(fern, BY_NAME["training_time_s"]) == "-66.67 ↑"
    assert rows[1]["verdict"] == "one replicate: no interval"
    assert (rows[0]["n_of"], rows[0]["change_unit"]) == ("scenes", "%")


def add_three(made: Any, *labels: str) -> None:
    """Three scenes in which the n-th label has n dB more PSNR, give or take a little."""
    for scene, noise in (("fern", -0.1), ("room", 0.0), ("trex", 0.1)):
        made.add(scene=scene)
        for number, label in enumerate(labels, start=1):
            made.add(label, scene=scene, values={"psnr": 20 + number + noise})


def test_q_and_the_marks_of_verdicts_stand_in_the_tables(made: Any) -> None:
    add_three(made, "a", "b")
    built = tables(made)
    (overview,) = built.overviews()
    rows = rows_of(overview)
    assert [rows[label]["PSNR, dB"] for label in "ab"] == ["+1.00 ↑ *", "+2.00 ↑ *"]
    assert [rows[label]["LPIPS, %"] for label in "ab"] == ["0.00 = ≈", "0.00 = ≈"]
    row = rows_of(built.mean("a", ""))["PSNR"]
    # t = 1 / (0.1 / sqrt(3)) with 2 degrees of freedom: p = 0.00332; the views of a cell differ by
    # the same, so that PSNR of the worst view and pooled are tests of equal p.
    assert (row["q"], row["verdict"], row["same sign (p)"]) == ("0.003", "better", "3 of 3 (0.250)")


def test_a_headline_label_has_holms_p_and_a_line_in_the_legend(made: Any) -> None:
    add_three(made, "a", "b")
    built = tables(made, design=Design(headline=("a",), margin_psnr=0.3, margin_lpips=7))
    # Three tests of p = 0.00332: PSNR in its three ways.
    row = rows_of(built.mean("a", ""))["PSNR"]
    assert (row["p (Holm)"], row["verdict"]) == ("0.010", "better")
    assert "q" not in row
    assert "q" in rows_of(built.mean("b", ""))["PSNR"]
    lines = meanings(built)
    assert lines["p (Holm)"].startswith("the p of a, corrected by Holm")
    assert lines["descriptive"].endswith("PSNR (worst view), LPIPS, Alpha evaluations, Gaussians")
    assert "0.3 dB of PSNR or 7 % of LPIPS" in lines["equivalent ≈"]
    assert "p (Holm)" not in meanings(tables(made))


@pytest.mark.slow
def test_the_legend_explains_only_what_occurs_and_fits_a_terminal(made: Any) -> None:
    made.add()
    made.add("a", factors={"psnr": 0.99})
    assert [*meanings(tables(made))] == ["change", "↑ ↓ ="]
    add_three(made, "a")
    built = tables(made)
    terms = meanings(built)
    assert {"95 % interval", "new scene", "q", "not shown", "descriptive"} <= {*terms}
    assert "(3 of 4)" not in terms
    made.add("b", factors={"psnr": 0.9})
    assert "(3 of 4)" in meanings(tables(made))
    lines = to_text(legend(built.comparison, [built.mean("a", "")])).split("\n")
    assert 80 < max(map(len, lines)) <= 100
    for meaning in terms.values():
        assert meaning in " ".join(" ".join(lines).split())


def test_an_ablation_that_is_the_baseline_is_said_to_change_nothing(made: Any) -> None:
    made.add()
    made.rows.append(made.rows[0] | {"label": "idle"})
    made.add("consistency", factors={"psnr": 0.99})
    built = tables(made)
    table = built.mean("idle", "")
    assert table.rows == (("idle changes nothing: its cells are the cells of baseline",),)
    assert built.per_scene("idle", "").rows == ()
    (overview,) = built.overviews()
    assert set(overview.rows[0][1:]) == {"="}
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


def test_every_table_has_its_context_and_cautions(made: Any) -> None:
    for scene in ("fern", "room"):
        made.add(scene=scene)
        made.add("consistency", scene=scene, factors={"gaussians": 0.5})
        made.add("plus", scene=scene, factors={"gaussians": 0.6})
    comparison = tables(made).comparison
    built = Tables(comparison, {"": Context(("3 steps",), ("a machine",), ("Caution: few",))})
    for table in (*built.overviews(), built.mean("plus", ""), built.per_scene("plus", "")):
        assert "Caution: few" in table.notes
        assert table.context == "3 steps; a machine"
    assert built.scores("").context == "3 steps"  # it has no times
    assert "Caution: few" in built.scores("").notes


def compared(made: Any) -> Comparison:
    return compare(made.read().cells, METRICS)


def gap_table(made: Any) -> TextTable:
    (one,) = Tables(compared(made), {"": Context(("500 steps",), ("a machine",))}).gaps()
    return one


def add_two_scenes(made: Any) -> None:
    """In fern 2 dB are lost, of which `a` regains 1 and `b` loses 1 more; in room none are."""
    for scene, top in (("fern", 22.0), ("room", 19.0)):
        for label, psnr in (("baseline", 20.0), ("a", 21.0), ("b", 19.0), ("all_hr", top)):
            made.add(label, scene=scene, values={"psnr": psnr})


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
    assert (len(built.align), built.context) == (len(built.columns), "500 steps")
    # Why there is no share is said once for all ablations.
    assert built.notes.count("PSNR, room: n/a (all_hr is worse)") == 1
    assert built.notes.count("SSIM, fern: n/a (all_hr has the same value)") == 1


def test_an_ablation_alone_without_a_share_is_named(made: Any) -> None:
    add_two_scenes(made)
    made.add("c", scene="fern", values={"psnr": None})
    made.add("c", scene="room", state="failed")
    built = gap_table(made)
    assert "PSNR, fern: n/a (not measured): c" in built.notes
    assert {row[:2]: row[2:4] for row in built.rows}["c", "PSNR"] == ("n/a", "missing")


def test_a_share_has_its_interval_and_signs(made: Any) -> None:
    made.add()
    made.add("all_hr")
    assert Tables(compared(made)).gaps() == [], "nothing else to compare"
    for seed, psnr in enumerate((21.0, 20.5), start=1):
        for label, value in (("baseline", 20.0), ("a", psnr), ("all_hr", 22.0)):
            made.add(label, values={"psnr": value}, seed=seed)
    row = next(row for row in gap_table(made).rows if row[:2] == ("a", "PSNR"))
    half = 12.5 * stats.t.ppf(0.975, 1)  # of 50 and 25 %
    assert row[3:] == ("+37.50", f"{37.5 - half:+.2f} to {37.5 + half:+.2f}", "2 of 2 (0.500)")
