"""The arithmetic of changes, against numbers worked out elsewhere."""

import math
from typing import Any

import numpy as np
import pytest
from scipy import stats

from tests.report.conftest import finish_again
from xrgs.evaluation.metrics import METRICS
from xrgs.report.collect import ReportError
from xrgs.report.compare import Comparison, Design, compare
from xrgs.report.inference import (
    NO_ALL_HR,
    NO_GAP,
    NOT_FINITE,
    NOT_POSITIVE,
    OTHER_CODE,
    OTHER_MACHINE,
    OTHER_THREADS,
    WRONG_GAP,
)
from xrgs.report.paper import paper_tables

#: Table 1 of the paper: mean change over seven scenes, and the arrow printed beside it.
TABLE_1 = {
    "training_time_s": (-44.57, "↑"),
    "gaussians": (-69.68, "↑"),
    "memory_bytes": (-46.50, "↑"),
    "lpips": (23.15, "↓"),
    "ssim": (0.45, "↑"),
    "psnr": (-0.80, "↓"),
}
SCENES = ("fern", "flower", "fortress", "horns", "orchids", "room", "trex")
#: Scatter of the scenes around the mean; sums to zero.
SCATTER = (-7.5, 3.25, 0.0, 1.25, -2.0, 4.0, 1.0)


#: The metrics that are compared by ratio.
AMOUNTS = {"training_time_s", "gaussians", "memory_bytes", "peak_rss_bytes", "evaluations"}


def interval_of(values: Any) -> Any:
    """Student's 95 % interval of the mean, by scipy."""
    return stats.ttest_1samp(values, 0).confidence_interval(0.95)


def compared(made: Any, against: str = "baseline") -> Comparison:
    return compare(made.read().cells, METRICS, against)


def mean_of(comparison: Comparison, metric: str, label: str = "consistency") -> Any:
    return comparison.means.xs((label, "", metric))


def test_the_papers_table_1(made: Any) -> None:
    """Pairs that have the paper's percentages as their mean ratio give its table again."""
    for number, (scene, off) in enumerate(zip(SCENES, SCATTER, strict=True)):
        size = dict.fromkeys(TABLE_1, 1.0 + number)  # no ratio of means would give the answer
        change = dict(size)
        for name, (mean, _) in TABLE_1.items():
            change[name] *= (1 + mean / 100) * math.exp(off / 100)
        many = {"gaussians": 5 * 10**12}  # whole numbers, whose ratios are rounded little
        made.add(scene=scene, factors=size, values=many)
        made.add("xrgs", scene=scene, factors=change, values=many)
    (table,) = paper_tables(compared(made), {})
    rows = {row[1]: row[2:] for row in table.rows}
    for metric in METRICS:
        if metric.name not in TABLE_1:
            continue
        expected, arrow = TABLE_1[metric.name]
        paper, here, interval, ratio, *_ = rows[metric.label]
        assert paper == here == f"{expected:+.2f} {arrow}"
        assert ratio == ("" if metric.name == "memory_bytes" else "1.00")
        offs = np.array(SCATTER) / 100 + math.log(1 + expected / 100)
        low, high = (100 * math.expm1(end) for end in interval_of(offs))
        assert interval == f"{low:+.2f} to {high:+.2f}"


def test_the_worst_view_and_the_pooled_error_are_of_each_cells_views(made: Any) -> None:
    made.add()  # of 20.05 and 19.95 dB
    cell = made.add("consistency")
    (cell.path / "scores.csv").write_text("view,psnr,ssim,lpips\nIMG_001,30,1,0\nIMG_009,10,1,0\n")
    finish_again(cell)
    comparison = compared(made)
    worst, pooled = (mean_of(comparison, f"psnr_{name}") for name in ("worst", "pooled"))
    assert worst["change"] == pytest.approx(10 - 19.95)
    assert pooled["value"] == pytest.approx(-10 * math.log10((1e-3 + 1e-1) / 2))


def test_outcomes_come_first_in_their_own_order(made: Any) -> None:
    made.add()
    made.add("consistency")
    design = Design(outcomes=("ssim", "gaussians"))
    cells = made.read().cells
    names = [metric.name for metric in compare(cells, METRICS, design=design).metrics]
    always = [metric.name for metric in METRICS if not metric.optional]
    assert names[:2] == ["ssim", "gaussians"]
    assert names[2:] == [name for name in always if name not in names[:2]]
    for design, message in (
        (Design(outcomes=("psnr", "nice")), r"outcomes=nice: .* metric; choose from: .*psnr"),
        (Design(headline=("plus",)), r"headline=plus: .* label; choose from: baseline, c"),
    ):
        with pytest.raises(ReportError, match=message):
            compare(cells, METRICS, design=design)
    with pytest.raises(ReportError, match=r"against=plus: .*choose from: baseline, consistency$"):
        compare(cells, METRICS, "plus")


def test_an_optional_score_is_compared_where_a_cell_has_it(made: Any) -> None:
    made.add()
    made.add("consistency")
    assert "psnr_plain" not in [metric.name for metric in compared(made).metrics]
    made.add(seed=1, values={"psnr_plain": 20.0})
    made.add("consistency", seed=1, values={"psnr_plain": 22.0})
    assert mean_of(compared(made), "psnr_plain")["change"] == pytest.approx(2.0)


def test_one_scene_has_its_interval_over_seeds(made: Any) -> None:
    changes = (-3.0, -1.0, 5.0)
    for seed, change in enumerate(changes):
        made.add(seed=seed)
        made.add("consistency", seed=seed, values={"psnr": 20 + change})
        if seed == 0:
            row = mean_of(compared(made), "psnr")
            assert row["change"] == pytest.approx(-3.0)
            assert np.isnan([row["low"], row["high"]]).all()
    row = mean_of(compared(made), "psnr")
    wanted = stats.t.interval(0.95, 2, loc=np.mean(changes), scale=stats.sem(changes))
    assert (row["low"], row["high"]) == pytest.approx(wanted, rel=1e-9)
    assert (row["n"], row["unit"]) == (3, "replicates")


def test_pairs_are_of_one_seed(made: Any) -> None:
    """Unpaired, the mean of the values would hide that both seeds went up by half."""
    for seed, size in enumerate((1.0, 10.0)):
        made.add(seed=seed, factors={"gaussians": size})
    for seed, size in enumerate((1.5, 15.0)):
        made.add("consistency", seed=seed, factors={"gaussians": size})
    pairs = compared(made).pairs.query("metric == 'gaussians'")
    assert list(pairs["effect"]) == pytest.approx([math.log(1.5)] * 2)


def test_a_failed_cell_is_left_out_and_said_to_be(made: Any) -> None:
    made.add()
    made.add("consistency", state="failed")
    made.add(scene="room")
    made.add("consistency", scene="room", factors={"gaussians": 3.0})
    made.add(scene="trex", state="failed")
    made.add("consistency", scene="trex")
    comparison = compared(made)
    assert mean_of(comparison, "gaussians")["change"] == pytest.approx(200.0)
    assert list(comparison.missing()["reason"]) == [
        *["RuntimeError: out of luck"] * 2,
        "no baseline: RuntimeError: out of luck",
    ]


def test_a_pair_that_is_left_out_does_not_narrow_the_interval(made: Any) -> None:
    """Three scenes, one of which has no percentage: the interval is of two values."""
    for scene, baseline, factor in (("fern", 100, 1.1), ("room", 200, 1.5), ("trex", 0, 1.0)):
        made.add(scene=scene, values={"gaussians": baseline})
        made.add("consistency", scene=scene, values={"gaussians": baseline * factor + 1})
    row = mean_of(compared(made), "gaussians")
    logs = np.log([111 / 100, 301 / 200])
    ends = [100 * (math.exp(end) - 1) for end in interval_of(logs)]
    assert (row["n"], row["scenes"]) == (2, 2)
    assert row["change"] == pytest.approx(100 * (math.exp(np.mean(logs)) - 1))
    assert (row["low"], row["high"]) == pytest.approx(ends, rel=1e-9)
    assert (row["base"], row["value"]) == pytest.approx((150, 206)), "of the same two pairs"
    assert row["why"] == NOT_POSITIVE


@pytest.mark.parametrize("against", ["baseline", "consistency"])
def test_times_of_another_machine_are_left_out(made: Any, against: str) -> None:
    changed = {"factors": {"training_time_s": 2.0, "render_time_ms": 2.0, "gaussians": 2.0}}
    for scene, cpu in (("fern", "a processor"), ("horns", "another"), ("room", "a processor")):
        made.add(scene=scene)
        made.add("consistency", scene=scene, cpu=cpu, **changed)
    comparison = compared(made, against)
    (label,) = {"baseline", "consistency"} - {against}
    change = 100.0 if against == "baseline" else -50.0
    for name, scenes, why in (
        ("training_time_s", 2, OTHER_MACHINE),
        ("render_time_ms", 2, OTHER_MACHINE),
        ("gaussians", 3, ""),
    ):
        mean = mean_of(comparison, name, label)
        assert (mean["change"], mean["scenes"], mean["why"]) == (pytest.approx(change), scenes, why)


@pytest.mark.parametrize(
    ("base", "other", "why"),
    [
        ({}, {"threads": 1}, OTHER_THREADS),
        # Of several machines in turn: like the times of no other cell.
        (turns := {"machines_in_turn": "a processor; another"}, turns, OTHER_MACHINE),
    ],
)
def test_times_of_other_threads_or_several_machines_are_not_compared(
    made: Any, base: dict[str, Any], other: dict[str, Any], why: str
) -> None:
    made.add(provenance=base)
    made.add("consistency", provenance=other)
    comparison = compared(made)
    assert mean_of(comparison, "training_time_s")["why"] == why
    assert mean_of(comparison, "gaussians")["why"] == ""


def test_times_of_an_unknown_machine_are_compared(made: Any) -> None:
    made.add()
    made.add("consistency", cpu="another")
    cells = made.read().cells
    cells.loc[cells["label"] == "baseline", "machine"] = ""
    assert mean_of(compare(cells, METRICS), "training_time_s")["why"] == ""


def test_a_draw_of_the_hr_views_is_a_replicate_with_a_variant_of_its_own(made: Any) -> None:
    """Three draws in a scene: paired within each, averaged over them, one interval of three."""
    changes = (10.0, 20.0, 60.0)
    for draw, change in enumerate(changes):
        own = 20.0 * (1 + draw)
        made.add(draw=draw, seed=draw, variant=f"v{draw}", values={"psnr": own})
        values = {"psnr": own + change}
        made.add("consistency", draw=draw, seed=draw, variant=f"v{draw}", values=values)
    comparison = compared(made)
    pairs = comparison.pairs.query("metric == 'psnr'")
    assert list(zip(pairs["variant_seed"], pairs["seed"], strict=True)) == [(0, 0), (1, 1), (2, 2)]
    row = mean_of(comparison, "psnr")
    wanted = stats.t.interval(0.95, 2, loc=np.mean(changes), scale=stats.sem(changes))
    assert row["change"] == pytest.approx(30.0)
    assert (row["low"], row["high"]) == pytest.approx(wanted, rel=1e-9)


def test_variants_of_one_draw_are_not_mixed(made: Any) -> None:
    made.add(draw=1, variant="aaaa")
    made.add("consistency", draw=1, seed=1, variant="bbbb")
    with pytest.raises(ReportError, match=r"variant.*cell00000.*aaaa.*cell00001.*bbbb"):
        compared(made)


def test_scores_of_held_out_training_views_are_not_mixed_with_scores_of_test_views(
    made: Any,
) -> None:
    made.add(validation=0.0)
    made.add("consistency")
    compared(made)
    made.add("late", validation=0.1)
    with pytest.raises(ReportError, match=r"train\.validation.*cell00000.* 0\.0.*cell00002.* 0\.1"):
        compared(made)
    made.rows[-1]["condition"] = "train.validation=0.1"
    with pytest.raises(ReportError, match=r"cell00002.* validation 0\.1.*cell00000.*: not a pair"):
        compared(made)


GAP = {"lpips": (0.4, 0.3, 0.2), "ssim": (0.5, 0.6, 0.9), "psnr": (20.0, 23.0, 24.0)}


def add_gap(
    made: Any,
    scene: str = "fern",
    *,
    seed: int = 0,
    scored_by: dict[str, dict[str, str]] | None = None,
    **psnr: float | None,
) -> None:
    """The three cells of a gap: the ablation closes 50, 25 and 75% of it."""
    for number, label in enumerate(("baseline", "consistency", "all_hr")):
        values: dict[str, float | None] = {name: of[number] for name, of in GAP.items()}
        values["psnr"] = psnr.get(label, values["psnr"])
        code = (scored_by or {}).get(label)
        made.add(label, scene=scene, seed=seed, values=values, scored_by=code)


def test_the_share_of_the_gap_is_averaged_by_scene_and_then_over_scenes(made: Any) -> None:
    """Gaps of 4 dB: fern closes 75 and 25%, room -25%. A ratio of sums would give 25%."""
    add_gap(made)
    add_gap(made, seed=1, consistency=21.0)
    add_gap(made, "room", consistency=19.0)
    comparison = compared(made)
    fern = comparison.gaps_per_scene["change"].xs("fern", level="scene").droplevel([0, 1])
    assert fern.to_dict() == pytest.approx({"lpips": 50.0, "ssim": 25.0, "psnr": 50.0})
    assert set(comparison.gaps.index.get_level_values("label")) == {"consistency"}
    by_scene = comparison.gaps_per_scene["change"].xs("psnr", level="metric")
    assert list(by_scene) == pytest.approx([50.0, -25.0])
    row = comparison.gaps.xs(("consistency", "", "psnr"))
    assert row["change"] == pytest.approx(12.5)
    interval = stats.t.interval(0.95, 1, loc=12.5, scale=stats.sem([50.0, -25.0]))
    assert (row["low"], row["high"]) == pytest.approx(interval, rel=1e-9)
    assert (row["up"], row["down"], row["pairs"]) == (1, 1, 3)


def test_a_gap_that_is_none_gives_no_share_and_the_reason(made: Any) -> None:
    reasons = {20.0: NO_GAP, 19.5: WRONG_GAP, None: NO_ALL_HR, math.inf: NOT_FINITE}
    for all_hr, why in reasons.items():
        add_gap(made, why, all_hr=all_hr)
    add_gap(made, "fern")
    made.add(scene="fern", seed=1)
    made.add("consistency", scene="fern", seed=1)
    made.add("all_hr", scene="fern", seed=1, state="failed")
    gaps = compared(made).gaps_per_scene.xs(("consistency", "", "psnr"), level=[0, 1, 3])
    for why in reasons.values():
        assert gaps.loc[why, "why"] == why
        assert np.isnan(gaps["change"].loc[why])
    row = gaps.loc["fern"]
    assert (row["change"], row["why"], row["pairs"]) == (pytest.approx(75.0), NO_ALL_HR, 1)


def test_there_is_no_gap_without_all_hr_of_the_same_condition(made: Any) -> None:
    made.add()
    made.add("consistency")
    made.add(condition="train.steps=9")
    made.add("all_hr", condition="train.steps=9")
    assert compared(made).gaps.empty


def test_protocols_are_not_mixed(made: Any) -> None:
    made.add()
    made.add("consistency")
    for label in ("baseline", "consistency"):
        made.add(label, scene="room", scored_by={"protocol": "other"})
    with pytest.raises(ReportError, match=r"protocol.*cell00000.* has .*cell00002.* has other"):
        compared(made)


def test_a_score_is_compared_where_the_same_code_has_computed_it(made: Any) -> None:
    for scene, code in (("fern", {"psnr": "old"}), ("room", {})):
        made.add(scene=scene, scored_by=code)
        made.add("consistency", scene=scene, factors={"psnr": 1.1, "ssim": 0.9})
    comparison = compared(made)
    psnr, ssim = (mean_of(comparison, name) for name in ("psnr", "ssim"))
    assert (psnr["change"], psnr["scenes"], psnr["why"]) == (pytest.approx(2), 1, OTHER_CODE)
    assert (ssim["scenes"], ssim["why"]) == (2, "")


def test_a_gap_is_closed_by_scores_of_the_same_code_alone(made: Any) -> None:
    """In fern the ablation was scored by other code, in room all_hr was."""
    for scene, other in (("fern", "consistency"), ("room", "all_hr"), ("trex", "")):
        add_gap(made, scene, scored_by={other: {"psnr": "old"}})
    comparison = compared(made)
    found = comparison.gaps_per_scene.xs(("consistency", "", "psnr"), level=[0, 1, 3])
    assert found["why"].to_dict() == {"fern": OTHER_CODE, "room": NO_ALL_HR, "trex": ""}
    assert comparison.gaps.xs(("consistency", "", "psnr"))["change"] == pytest.approx(75.0)


@pytest.mark.parametrize(("key", "other"), [("seed", {"seed": 1}), ("scene", {"scene": "room"})])
def test_a_baseline_of_another_seed_or_scene_is_refused(
    made: Any, key: str, other: dict[str, Any]
) -> None:
    made.add(variant="v")
    made.add("consistency", variant="v", **other)
    made.rows[1]["baseline_id"] = "cell00000"
    with pytest.raises(ReportError, match=rf"cell00001.* has {key}.*cell00000 has {key}"):
        compared(made)


def test_a_baseline_outside_the_sweep_is_refused(made: Any) -> None:
    made.add("consistency")
    with pytest.raises(ReportError, match=r"cell00000.*baseline .* is not in the sweep"):
        compared(made)


def test_cells_of_a_sweep_without_a_baseline_are_compared_with_that_of_a_joined_one(
    made: Any,
) -> None:
    for seed, psnr in enumerate((20.0, 22.0)):
        made.add(seed=seed, values={"psnr": psnr})
        made.add("plus", seed=seed, values={"psnr": psnr + 1 + seed})
        made.rows[-1]["baseline_id"] = None
    pairs = compared(made).pairs.query("metric == 'psnr'")
    assert list(pairs["effect"]) == pytest.approx([1, 2])


def test_a_cell_whose_base_failed_or_was_not_planned_says_so(made: Any) -> None:
    made.add()
    made.add("plus", state="failed")
    made.add("xrgs")
    made.add(scene="room")
    made.add("xrgs", scene="room")
    made.add_error("trex", "plus")
    made.add_error("trex", "xrgs")
    comparison = compared(made, "plus")
    assert comparison.pairs.empty
    reasons = comparison.missing().set_index(["scene", "label"])["reason"].to_dict()
    assert reasons["fern", "xrgs"] == "no plus: RuntimeError: out of luck"
    assert reasons["fern", "baseline"] == "no plus: RuntimeError: out of luck"
    assert reasons["room", "xrgs"] == "no plus: not planned for its scene, condition and replicate"
    assert reasons["trex", "xrgs"] == "trex: 3 of 24 views registered"
