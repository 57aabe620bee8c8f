"""The arithmetic of percentage changes, against numbers worked out elsewhere."""

import math
from itertools import pairwise
from typing import Any

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from xrgs.evaluation.metrics import METRICS
from xrgs.report.collect import ReportError, read_sweep
from xrgs.report.compare import (
    NOT_FINITE,
    NOT_MEASURED,
    ZERO_BASELINE,
    Comparison,
    compare,
    half_width,
    percent_change,
)
from xrgs.report.tables import percent

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


def compared(made: Any) -> Comparison:
    return compare(read_sweep(made.store, made.write(), METRICS).cells, METRICS)


def mean_of(comparison: Comparison, metric: str, label: str = "consistency") -> Any:
    return comparison.means.xs((label, "", metric))


def test_the_papers_table_1(made: Any) -> None:
    for number, (scene, off) in enumerate(zip(SCENES, SCATTER, strict=True)):
        size = dict.fromkeys(TABLE_1, 1.0 + number)  # no ratio of means would give the answer
        change = {
            name: size[name] * (1 + (mean + off) / 100) for name, (mean, _) in TABLE_1.items()
        }
        made.add(scene=scene, factors=size)
        made.add("xrgs", scene=scene, factors=change)
    comparison = compared(made)
    for metric in METRICS:
        if metric.name not in TABLE_1:
            continue
        expected, arrow = TABLE_1[metric.name]
        row = mean_of(comparison, metric.name, "xrgs")
        assert row["change"] == pytest.approx(expected, abs=1e-9)
        assert percent(row["change"], metric) == f"{expected:+.2f} {arrow}"
        assert row["n"] == 7
        per_scene = comparison.per_scene.loc[("xrgs", "", slice(None), metric.name), "change"]
        wanted = stats.ttest_1samp(per_scene, 0).confidence_interval(0.95)
        assert (row["low"], row["high"]) == pytest.approx(wanted, rel=1e-9)


def test_scenes_count_once_however_many_seeds_they_have(made: Any) -> None:
    for seed, factor in enumerate((1.1, 1.2, 1.3)):
        made.add(seed=seed)
        made.add("consistency", seed=seed, factors={"gaussians": factor})
    made.add(scene="room")
    made.add("consistency", scene="room", factors={"gaussians": 2.0})
    row = mean_of(compared(made), "gaussians")
    assert row["change"] == pytest.approx((20 + 100) / 2)
    assert (row["n"], row["unit"]) == (2, "scenes")


def test_one_scene_has_its_interval_over_seeds(made: Any) -> None:
    changes = (-3.0, -1.0, 5.0)
    for seed, change in enumerate(changes):
        made.add(seed=seed)
        made.add("consistency", seed=seed, factors={"training_time_s": 1 + change / 100})
    row = mean_of(compared(made), "training_time_s")
    wanted = stats.t.interval(0.95, 2, loc=np.mean(changes), scale=stats.sem(changes))
    assert (row["low"], row["high"]) == pytest.approx(wanted, rel=1e-9)
    assert (row["n"], row["unit"]) == (3, "replicates")


def test_one_seed_has_no_interval(made: Any) -> None:
    made.add()
    made.add("consistency", factors={"psnr": 1.1})
    row = mean_of(compared(made), "psnr")
    assert row["change"] == pytest.approx(10)
    assert row["difference"] == pytest.approx(2.0)  # dB
    assert math.isnan(row["low"])
    assert math.isnan(row["high"])


def test_pairs_are_of_one_seed(made: Any) -> None:
    """Unpaired, the mean of the values would hide that both seeds went up by half."""
    for seed, size in enumerate((1.0, 10.0)):
        made.add(seed=seed, factors={"gaussians": size})
    for seed, size in enumerate((1.5, 15.0)):
        made.add("consistency", seed=seed, factors={"gaussians": size})
    comparison = compared(made)
    assert list(comparison.pairs.query("metric == 'gaussians'")["change"]) == [50.0, 50.0]


def test_conditions_are_compared_apart(made: Any) -> None:
    for condition, factor in (("train.steps=100", 0.5), ("train.steps=200", 2.0)):
        made.add(condition=condition)
        made.add("consistency", condition=condition, factors={"gaussians": factor})
    means = compared(made).means["change"]
    assert means["consistency", "train.steps=100", "gaussians"] == -50.0
    assert means["consistency", "train.steps=200", "gaussians"] == 100.0


def test_a_failed_cell_is_left_out_and_said_to_be(made: Any) -> None:
    made.add()
    made.add("consistency", state="failed")
    made.add(scene="room")
    made.add("consistency", scene="room", factors={"gaussians": 3.0})
    comparison = compared(made)
    assert mean_of(comparison, "gaussians")["change"] == 200.0
    assert list(comparison.missing()["reason"]) == ["RuntimeError: out of luck"]


def test_an_ablation_whose_baseline_failed_is_no_pair(made: Any) -> None:
    made.add(state="failed")
    made.add("consistency")
    comparison = compared(made)
    assert comparison.pairs.empty
    assert list(comparison.missing()["reason"]) == [
        "RuntimeError: out of luck",
        "no baseline: RuntimeError: out of luck",
    ]


def test_a_metric_that_one_view_lacks_is_not_averaged(made: Any) -> None:
    made.add(values={"lpips": None})
    made.add("consistency", values={"lpips": None})
    row = mean_of(compared(made), "lpips")
    assert math.isnan(row["change"])
    assert row["why"] == NOT_MEASURED


def test_a_pair_that_is_left_out_does_not_narrow_the_interval(made: Any) -> None:
    """Three scenes, one of which has no percentage: the interval is of two values."""
    for scene, baseline, factor in (("fern", 100, 1.1), ("room", 200, 1.5), ("trex", 0, 1.0)):
        made.add(scene=scene, values={"gaussians": baseline})
        made.add("consistency", scene=scene, values={"gaussians": baseline * factor + 1})
    row = mean_of(compared(made), "gaussians")
    changes = (100 * 0.1 + 100 / 100, 100 * 0.5 + 100 / 200)
    interval = stats.t.interval(0.95, 1, loc=np.mean(changes), scale=stats.sem(changes))
    assert row["n"] == 2
    assert row["change"] == pytest.approx(np.mean(changes))
    assert (row["low"], row["high"]) == pytest.approx(interval, rel=1e-9)
    assert row["why"] == ZERO_BASELINE


def test_variants_are_not_mixed(made: Any) -> None:
    made.add(variant="aaaa")
    made.add("consistency", variant="bbbb")
    with pytest.raises(ReportError, match=r"variant.*cell00000.*aaaa.*cell00001.*bbbb"):
        compared(made)


def test_protocols_are_not_mixed(made: Any) -> None:
    made.add()
    made.add("consistency")
    made.add(scene="room", protocol=2)
    made.add("consistency", scene="room", protocol=2)
    with pytest.raises(ReportError, match=r"protocol.*cell00000.* has 1.*cell00002.* has 2"):
        compared(made)


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


FLOATS = st.floats(-1e6, 1e6, allow_subnormal=False).filter(lambda x: abs(x) > 1e-6)
PAIRS = st.lists(st.tuples(FLOATS, FLOATS), min_size=1, max_size=20)


@given(PAIRS, st.integers(-40, 40))
def test_a_percentage_has_no_unit(pairs: list[tuple[float, float]], power: int) -> None:
    baseline, value = np.array(pairs).T
    scale = 2.0**power  # exact, so that the result must be too
    assert np.array_equal(
        percent_change(baseline, value)[0], percent_change(baseline * scale, value * scale)[0]
    )


@given(st.lists(st.floats(-1e300, 1e300), min_size=1))
def test_a_baseline_against_itself_is_zero(values: list[float]) -> None:
    change, why = percent_change(np.array(values), np.array(values))
    assert np.array_equal(change, np.zeros(len(values)))
    assert set(why) == {""}


@given(FLOATS, FLOATS)
def test_more_is_a_positive_change_even_below_zero(baseline: float, value: float) -> None:
    change = percent_change(np.array([baseline]), np.array([value]))[0][0]
    assert np.sign(change) == np.sign(value - baseline)


@pytest.mark.parametrize(
    ("baseline", "value", "why"),
    [
        (0.0, 1.0, ZERO_BASELINE),
        (0.0, math.inf, NOT_FINITE),
        (math.nan, 1.0, NOT_MEASURED),
        (1.0, math.nan, NOT_MEASURED),
        (math.inf, 1.0, NOT_FINITE),
        (1.0, math.inf, NOT_FINITE),
        (math.inf, math.inf, NOT_FINITE),
        (1e-300, 1e300, NOT_FINITE),
    ],
)
def test_where_there_is_no_percentage_the_reason_is_given(
    baseline: float, value: float, why: str
) -> None:
    change, found = percent_change(np.array([baseline]), np.array([value]))
    assert math.isnan(change[0])
    assert list(found) == [why]


@given(st.lists(st.floats(-100, 100), min_size=2, max_size=40))
def test_the_interval_is_scipys(values: list[float]) -> None:
    spread = float(np.std(values, ddof=1))
    found = half_width(np.array([spread]), np.array([float(len(values))]))[0]
    wanted = stats.t.ppf(0.975, len(values) - 1) * spread / math.sqrt(len(values))
    assert found == pytest.approx(wanted, rel=1e-9)


def test_more_values_make_a_narrower_interval() -> None:
    widths = half_width(np.ones(30), np.arange(1.0, 31.0))
    assert math.isnan(widths[0])
    assert all(wide > narrow for wide, narrow in pairwise(widths[1:]))


def test_the_arithmetic_does_not_grow_faster_than_the_cells(made: Any) -> None:
    """Ten thousand cells give the numbers that a plain loop gives."""
    rng = np.random.default_rng(0)
    n = 5000
    scenes = [f"scene{number % 50}" for number in range(n)]
    base = pd.DataFrame(
        {
            "scene": scenes, "condition": "", "label": "baseline", "seed": np.arange(n) // 50,
            "cell_id": [f"b{number}" for number in range(n)], "variant_id": scenes,
            "baseline_id": [f"b{number}" for number in range(n)], "error": None,
            "state": "done", "reason": "", "protocol": 1, "variant_seed": 0, "validation": 0.0,
        }
    )  # fmt: skip
    names = [metric.name for metric in METRICS]
    base[names] = rng.uniform(1, 2, (n, len(names)))
    ablation = base.assign(label="a", cell_id=[f"a{number}" for number in range(n)])
    ablation[names] = rng.uniform(1, 2, (n, len(names)))
    comparison = compare(pd.concat([base, ablation], ignore_index=True), METRICS)
    change = 100 * (ablation["psnr"] / base["psnr"] - 1)
    by_scene = [np.mean(change[np.array(scenes) == name]) for name in dict.fromkeys(scenes)]
    assert mean_of(comparison, "psnr", "a")["change"] == pytest.approx(np.mean(by_scene))
