"""What a number looks like in a table, and what is said of it."""

import csv
import io
import math
from typing import Any

import pytest

from xrgs.evaluation.metrics import METRICS, Metric
from xrgs.report.collect import read_sweep
from xrgs.report.compare import compare
from xrgs.report.tables import ARROWS_NOTE, Change, Tables, arrow, number, percent, reading, signed

BY_NAME = {metric.name: metric for metric in METRICS}
#: Whether more of it is better, from the metrics' own papers and common sense, not from the code.
MORE_IS_BETTER = {
    "training_time_s": False,
    "render_time_ms": False,
    "gaussians": False,
    "memory_bytes": False,
    "peak_rss_bytes": False,
    "lpips": False,
    "ssim": True,
    "psnr": True,
    "evaluations": False,
}


def tables(made: Any) -> Tables:
    return Tables(compare(read_sweep(made.store, made.write(), METRICS).cells, METRICS))


def change(mean: float, low: float = math.nan, high: float = math.nan, why: str = "") -> Change:
    return Change(1.0, 1.0, mean, 0.0, 0.0, 2, low, high, "replicates", why, 2, 2)


@pytest.mark.parametrize("metric", METRICS, ids=lambda metric: metric.name)
def test_arrows_point_up_where_it_got_better(metric: Metric) -> None:
    more = MORE_IS_BETTER[metric.name]
    assert arrow(5.0, metric) == ("↑" if more else "↓")
    assert arrow(-5.0, metric) == ("↓" if more else "↑")
    assert arrow(0.0, metric) == "="
    assert arrow(-0.004, metric) == "="  # what is printed is 0.00
    assert arrow(math.nan, metric) == " "


@pytest.mark.parametrize(
    ("value", "text"),
    [(-44.566, "-44.57"), (0.45, "+0.45"), (-0.001, "0.00"), (0.0, "0.00"), (-0.0, "0.00"),
     (12345.678, "+12,345.68"), (math.nan, "n/a")],
)  # fmt: skip
def test_changes_are_signed(value: float, text: str) -> None:
    assert signed(value) == text


@pytest.mark.parametrize(
    ("value", "unit", "text"),
    [
        (83.456, "s", "83.46 s"),
        (1234.5, "s", "1,234 s"),
        (123456.0, "", "123,456"),
        (7.0, "", "7"),
        (0.81234, "", "0.8123"),
        (24.0, "dB", "24.00 dB"),
        (3 * 2**20, "bytes", "3.0 MiB"),
        (math.inf, "dB", "inf dB"),
        (math.nan, "dB", "n/a"),
    ],
)
def test_values_have_their_unit(value: float, unit: str, text: str) -> None:
    assert number(value, unit) == text


@pytest.mark.parametrize(
    ("row", "text"),
    [
        (change(5.0), "one replicate: no interval"),
        (change(5.0, 1.0, 9.0), "better"),
        (change(-5.0, -9.0, -1.0), "worse"),
        (change(5.0, -1.0, 11.0), "inside noise"),
        (change(5.0, 0.0, 10.0), "inside noise"),
        (change(0.0, 0.0, 0.0), "unchanged"),
        (change(0.0, -1.0, 1.0), "inside noise"),
        (change(0.002, 0.001, 0.003), "unchanged"),
        (change(math.nan, why="not measured"), "n/a: not measured"),
    ],
)
def test_what_an_interval_allows_to_be_said_of_psnr(row: Change, text: str) -> None:
    assert reading(row, BY_NAME["psnr"]) == text


def test_less_gaussians_outside_noise_are_better() -> None:
    assert reading(change(-5.0, -9.0, -1.0), BY_NAME["gaussians"]) == "better"


def test_psnr_has_decibels_beside_its_percentage(made: Any) -> None:
    made.add()
    made.add("consistency", factors={"psnr": 0.99})
    table = tables(made).mean("consistency", "")
    rows = {row[0]: row for row in table.rows}
    assert rows["PSNR"] == (
        "PSNR", "20.00 dB", "19.80 dB", "-1.00 ↓", "-0.20", "",
        "1 of 1", "one replicate: no interval",
    )  # fmt: skip
    assert rows["SSIM"][4] == ""
    assert table.title == "consistency against baseline: scene fern, seed 0"


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
    assert rows["Gaussians, %"] == ["-50.00 ↑", "failed", "failed", "-50.00 ↑"]
    assert rows["PSNR, dB"] == ["0.00", "failed", "failed", "0.00"]
    assert "1 of 3 scenes" in built.mean("consistency", "").title
    missing = built.missing()
    assert missing is not None
    assert missing.title == "3 of 6 cells gave no number"
    assert ("leaves", "baseline", "", "0", "0", "failed", "leaves: 3 of 24 views registered") in (
        missing.rows
    )


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
    (table,) = tables(made).overviews()
    assert table.columns == ("Metric", "consistency", "loss_weighting")
    assert ("Gaussians", "-50.00 ↑", "failed  ") in table.rows
    assert table.title == "Change from baseline, %, mean over scenes"
    assert table.align == "lrr"
    assert table.notes == (ARROWS_NOTE,)


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
    assert "Gaussians: pairs left out (the baseline is zero)" in table.notes
    assert next(row for row in table.rows if row[0] == "Gaussians")[3] == "+100.00 ↓"


def test_the_long_table_has_every_number_at_full_precision(made: Any) -> None:
    for scene, factor in (("fern", 1 / 3), ("room", 1 / 7)):
        made.add(scene=scene)
        made.add("consistency", scene=scene, factors={"training_time_s": factor})
    text = tables(made).long().to_csv(index=False)
    rows = [r for r in csv.DictReader(io.StringIO(text)) if r["metric"] == "training_time_s"]
    assert [row["level"] for row in rows] == ["mean", "scene", "scene"]
    assert [row["scene"] for row in rows] == ["", "fern", "room"]
    fern, room = (100 * (100 * factor - 100) / 100 for factor in (1 / 3, 1 / 7))
    assert float(rows[1]["change_percent"]) == fern
    assert float(rows[0]["change_percent"]) == pytest.approx((fern + room) / 2, rel=1e-15)
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
    assert rows["fern", "Gaussians"] == ("30", "failed")
    by_scene = built.per_scene("consistency", "train.steps=20")
    assert by_scene.title == "consistency: change from baseline, scene by scene (train.steps=20)"
    assert by_scene.align == "lrrr"
    assert by_scene.notes == (ARROWS_NOTE,)


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
