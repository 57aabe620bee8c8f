"""Scatter, agreement and tests of means over replicates and scenes, of made-up pairs."""

import math
from typing import Any

import numpy as np
import pytest
from scipy import stats

from tests.report.test_compare import AMOUNTS, SCENES, compared, mean_of
from xrgs.evaluation.metrics import METRICS
from xrgs.report.inference import NOT_MEASURED


def test_pairs_that_agree_are_counted_by_the_sign_of_the_mean(made: Any) -> None:
    """Scenes' means are +20 and -5, so the mean is up: 3 of 5 pairs are."""
    for scene, changes in (("fern", (30.0, 10.0)), ("room", (-9.0, 3.0, -9.0))):
        for seed, change in enumerate(changes):
            made.add(scene=scene, seed=seed)
            factors = {"gaussians": 1 + change / 100, "psnr": 1.0}
            made.add("consistency", scene=scene, seed=seed, factors=factors)
    comparison = compared(made)
    row = mean_of(comparison, "gaussians")
    of_fern, of_room = 1.3 * 1.1, 0.91 * 1.03 * 0.91
    ratio = math.sqrt(of_fern ** (1 / 2) * of_room ** (1 / 3))
    assert row["change"] == pytest.approx(100 * (ratio - 1))
    assert (row["agree"], row["pairs"]) == (3, 5)
    room = comparison.per_scene.xs(("consistency", "", "room", "gaussians"))
    assert (room["agree"], room["pairs"]) == (2, 3)
    assert tuple(mean_of(comparison, "psnr")[["agree", "pairs"]]) == (5, 5), "all are unchanged"


def test_a_pair_without_a_change_neither_agrees_nor_counts(made: Any) -> None:
    for seed, lpips in enumerate((None, 0.25)):
        made.add(seed=seed, values={"lpips": lpips})
        made.add("consistency", seed=seed, factors={"psnr": 1.1})
    assert tuple(mean_of(compared(made), "lpips")[["agree", "pairs"]]) == (1, 1)


def add_nested(made: Any, changes: dict[str, tuple[float, ...]], metric: str = "psnr") -> None:
    """Pairs of each scene: percentages of a score, or logarithms times 100 of an amount."""
    for scene, of_scene in changes.items():
        for seed, change in enumerate(of_scene):
            factor = math.exp(change / 100) if metric in AMOUNTS else 1 + change / 100
            made.add(scene=scene, seed=seed)
            made.add("consistency", scene=scene, seed=seed, factors={metric: factor})


NESTED = {"fern": (1.0, 3.0, 5.0), "room": (10.0, 12.0), "trex": (7.0,)}


@pytest.mark.parametrize("metric", ["psnr", "evaluations"])
def test_replicates_scatter_within_scenes_and_scenes_by_their_means(made: Any, metric: str) -> None:
    """Sums of squares 8 and 2 of 2 + 1 degrees of freedom; means 3, 11, 7."""
    add_nested(made, NESTED, metric)
    comparison = compared(made)
    row = mean_of(comparison, metric)
    fern: Any = comparison.per_scene.xs(("consistency", "", "fern", metric))
    wanted = {"replicates": math.sqrt(10 / 3), "scenes": 4.0, "fern": 2.0}
    if metric in AMOUNTS:
        wanted = {name: 100 * math.expm1(of / 100) for name, of in wanted.items()}
    assert row["scatter_replicates"] == pytest.approx(wanted["replicates"])
    assert row["scatter_scenes"] == pytest.approx(wanted["scenes"])
    assert fern["scatter_replicates"] == pytest.approx(wanted["fern"])
    assert math.isnan(fern["scatter_scenes"])


def test_one_replicate_a_scene_has_no_scatter_of_replicates(made: Any) -> None:
    add_nested(made, {"fern": (1.0,), "room": (3.0,)})
    row = mean_of(compared(made), "psnr")
    assert math.isnan(row["scatter_replicates"])
    assert row["scatter_scenes"] == pytest.approx(math.sqrt(2))


def test_q_is_over_all_ablations_and_metrics_of_a_condition(made: Any) -> None:
    """Three scenes, of which scipy tests the means; a condition of two has no test."""
    rng = np.random.default_rng(0)
    always = [metric for metric in METRICS if not metric.optional]
    for condition, scenes in (("", SCENES[:3]), ("train.steps=9", SCENES[:3]), ("two", SCENES[:2])):
        for scene in scenes:
            made.add(scene=scene, condition=condition)
            for label in ("a", "b"):
                of = {metric.name: rng.uniform(0.99, 1.02) for metric in always}
                made.add(label, scene=scene, condition=condition, factors=of)
    comparison = compared(made)
    effects = comparison.pairs.groupby(["label", "condition", "metric"])["effect"].agg(list)
    for condition in ("", "train.steps=9"):
        means = comparison.means.xs(condition, level="condition")
        tests = [stats.ttest_1samp(of, 0).pvalue for of in effects.xs(condition, level=1)]
        wanted = dict(zip(effects.xs(condition, level=1).index, tests, strict=True))
        p = [wanted[key] for key in means.index]
        assert len(p) == 2 * len(always)
        assert means["p"].to_numpy() == pytest.approx(p, rel=1e-7)
        assert means["q"].to_numpy() == pytest.approx(stats.false_discovery_control(p), rel=1e-7)
    assert comparison.means.xs("two", level="condition")[["p", "q"]].isna().to_numpy().all()
    assert comparison.per_scene["q"].isna().all()


def test_means_of_base_and_value_cover_the_pairs_that_have_a_change(made: Any) -> None:
    """Without room, whose ablation has no LPIPS: 0.1 and 0.2, which is +100 %."""
    for scene, base, value in (("fern", 0.1, 0.2), ("room", 0.5, None)):
        made.add(scene=scene, values={"lpips": base})
        made.add("consistency", scene=scene, values={"lpips": value})
    for seed, of_base, of_value in ((1, 0.7, None), (2, None, 0.7)):
        made.add(seed=seed, values={"lpips": of_base})
        made.add("consistency", seed=seed, values={"lpips": of_value})
    comparison = compared(made)
    for row in (
        mean_of(comparison, "lpips"),
        comparison.per_scene.xs(("consistency", "", "fern", "lpips")),
    ):
        assert row["change"] == pytest.approx(100)
        assert tuple(row[["base", "value", "difference"]]) == pytest.approx((0.1, 0.2, 0.1))
        assert (row["scenes"], row["pairs"], row["why"]) == (1, 1, NOT_MEASURED)
