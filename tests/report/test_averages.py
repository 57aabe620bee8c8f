"""Scatter, signs, intervals and tests of means over replicates and scenes, of made-up pairs."""

import math
from typing import Any

import numpy as np
import pytest
from scipy import stats

from tests.report.test_compare import AMOUNTS, SCENES, compared, mean_of
from xrgs.evaluation.metrics import METRICS
from xrgs.report.compare import Comparison, Design, compare
from xrgs.report.inference import NOT_MEASURED


def test_scenes_are_counted_by_the_sign_of_their_mean(made: Any) -> None:
    """Scenes' means are up, down, up and level: the mean is up, as 2 of 4 scenes are."""
    by_scene = {
        "fern": (30.0, -10.0), "room": (-9.0, 3.0, -9.0), "trex": (10.0,), "horns": (0.0,)
    }  # fmt: skip
    for scene, changes in by_scene.items():
        for seed, change in enumerate(changes):
            made.add(scene=scene, seed=seed)
            factors = {"gaussians": math.exp(change / 100), "psnr": 1.0}
            made.add("consistency", scene=scene, seed=seed, factors=factors)
    comparison = compared(made)
    row = mean_of(comparison, "gaussians")
    assert row["change"] == pytest.approx(100 * math.expm1(0.15 / 4), abs=0.05)  # whole Gaussians
    assert tuple(row[["up", "down", "n", "pairs"]]) == (2, 1, 4, 7)
    assert row["p_sign"] == pytest.approx(stats.binomtest(2, 3).pvalue)
    room = comparison.per_scene.xs(("consistency", "", "room", "gaussians"))
    assert tuple(room[["up", "down", "n", "pairs"]]) == (1, 2, 3, 3)
    same = mean_of(comparison, "psnr")
    assert tuple(same[["up", "down", "n", "p_sign"]]) == (0, 0, 4, 1.0)


def add_nested(made: Any, changes: dict[str, tuple[float, ...]], metric: str = "psnr") -> None:
    """Pairs of each scene: dB of PSNR, or logarithms times 100 of an amount."""
    for scene, of_scene in changes.items():
        for seed, change in enumerate(of_scene):
            factor = math.exp(change / 100) if metric in AMOUNTS else 1 + change / 20
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
    half = stats.t.ppf(0.975, 2) * 4.0 * math.sqrt(1 + 1 / 3)
    new = [7 - half, 7 + half]
    if metric in AMOUNTS:
        new = [100 * math.expm1(end / 100) for end in new]
    assert (row["new_low"], row["new_high"]) == pytest.approx(new)
    assert fern["scatter_replicates"] == pytest.approx(wanted["fern"])
    assert math.isnan(fern["scatter_scenes"])
    assert math.isnan(fern["new_low"]), "one scene says nothing of a new one"
    trex: Any = comparison.per_scene.xs(("consistency", "", "trex", metric))
    assert math.isnan(trex["scatter_replicates"])


SCORES, WORK = ("psnr", "psnr_pooled", "psnr_worst", "lpips"), ("evaluations", "gaussians")


def add_random(made: Any, labels: tuple[str, ...], conditions: dict[str, int]) -> None:
    """Conditions of so many scenes, in which every metric of every label differs by chance."""
    rng = np.random.default_rng(0)
    always = [m.name for m in METRICS if not m.optional and m.name not in SCORES[1:3]]
    for condition, scenes in conditions.items():
        for scene in SCENES[:scenes]:
            made.add(scene=scene, condition=condition)
            for label in labels:
                of = {name: rng.uniform(0.99, 1.02) for name in always}
                made.add(label, scene=scene, condition=condition, factors=of)


def p_of(comparison: Comparison, condition: str) -> dict[Any, float]:
    """The p of each label and metric of a condition, by scipy."""
    pairs = comparison.pairs[comparison.pairs["condition"] == condition]
    effects = pairs.groupby(["label", "metric"])["effect"]
    return {key: stats.ttest_1samp(of, 0).pvalue for key, of in effects if of.notna().all()}


def test_q_is_over_the_outcomes_of_a_condition_scores_and_amounts_apart(made: Any) -> None:
    """Three scenes, of which scipy tests the means; a condition of two has no test."""
    add_random(made, ("a", "b"), {"": 3, "train.steps=9": 3, "two": 2})
    comparison = compared(made)
    for condition in ("", "train.steps=9"):
        p = p_of(comparison, condition)
        q = comparison.means["q"].xs(condition, level="condition")
        for family in (SCORES, WORK):
            keys = [(label, metric) for label in ("a", "b") for metric in family]
            wanted = stats.false_discovery_control([p[key] for key in keys])
            assert q[keys].to_numpy() == pytest.approx(wanted, rel=1e-7)
        assert q.notna().sum() == 2 * len(SCORES + WORK)
    assert comparison.means.xs("two", level="condition")[["p", "q"]].isna().to_numpy().all()


def test_headline_labels_are_corrected_by_holm_among_themselves(made: Any) -> None:
    """The corrected p of hand: p times the number of p that are not smaller, made monotone."""
    add_random(made, ("a", "b", "c"), {"": 4})
    design = Design(outcomes=("psnr", "lpips", "gaussians"), headline=("a", "c"))
    means = compare(made.read().cells, METRICS, design=design).means.xs("", level="condition")
    for family in (("psnr", "lpips"), ("gaussians",)):
        keys = [(label, metric) for label in ("a", "c") for metric in family]
        p = means["p"][keys].sort_values()
        by_rank = p.to_numpy() * np.arange(len(p), 0, -1)
        wanted = np.minimum(1, np.maximum.accumulate(by_rank))
        assert means["holm"][p.index].to_numpy() == pytest.approx(wanted)
    assert means["holm"].xs("b", level="label").isna().all()
    assert means["holm"].notna().sum() == 6
    assert means["q"].notna().sum() == 9


def test_equal_values_are_no_members_of_the_family(made: Any) -> None:
    """An ablation that changes no score would halve q of the other one's, or double it."""
    for number, scene in enumerate(SCENES[:3]):
        made.add(scene=scene)
        made.add("same", scene=scene)
        made.add("other", scene=scene, factors={"lpips": 0.9 + number / 100})
    means = compared(made).means.xs("", level="condition")
    assert means["q"]["other", "lpips"] == pytest.approx(means["p"]["other", "lpips"])
    assert means["q"].xs("same").isna().all()
    assert (means["p_equivalent"].xs("same").dropna() == 0).all()


def test_equivalence_is_within_the_margins_of_the_design(made: Any) -> None:
    """In dB for PSNR, by log ratio for LPIPS; of other metrics without a margin."""
    offs = (-0.02, 0.0, 0.02, 0.04)
    for scene, off in zip(SCENES, offs, strict=False):
        made.add(scene=scene)
        factors = {"psnr": 1 + off / 20, "lpips": math.exp(off), "gaussians": 1 + off}
        made.add("a", scene=scene, factors=factors)
    for psnr, lpips in ((0.2, 5.0), (0.02, 2.0)):
        design = Design(margin_psnr=psnr, margin_lpips=lpips)
        means = compare(made.read().cells, METRICS, design=design).means.droplevel([0, 1])
        for name, margin in (("psnr", psnr), ("lpips", math.log(1 + lpips / 100))):
            tests = [stats.ttest_1samp(offs, -margin, alternative="greater").pvalue,
                     stats.ttest_1samp(offs, margin, alternative="less").pvalue]  # fmt: skip
            assert means["p_equivalent"][name] == pytest.approx(max(tests), rel=1e-6)
        assert means["p_equivalent"]["gaussians"] >= 0.5


@pytest.mark.slow
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
        assert tuple(row[["base", "value"]]) == pytest.approx((0.1, 0.2))
        assert (row["scenes"], row["pairs"], row["why"]) == (1, 1, NOT_MEASURED)
