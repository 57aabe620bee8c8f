"""The axes of a command line become combinations, each with its matching baseline."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from xrgs.errors import XrgsError
from xrgs.sweep.study import BASELINE, expand


def named(*arguments: str) -> list[tuple[str, str]]:
    return [(wish.label, wish.condition) for wish in expand(arguments)]


def test_nothing_given_is_the_baseline() -> None:
    assert named() == [(BASELINE, "")]


@pytest.mark.parametrize("prefix", ["+", "", "++"])
def test_an_ablation_brings_its_baseline(prefix: str) -> None:
    assert named(f"{prefix}ablation=consistency") == [(BASELINE, ""), ("consistency", "")]


def test_the_baseline_named_is_not_run_twice() -> None:
    assert named("+ablation=baseline,consistency") == [(BASELINE, ""), ("consistency", "")]


def test_ablations_stack() -> None:
    assert named("+ablation=[loss_weighting,consistency]")[1][0] == "loss_weighting+consistency"


def test_each_seed_and_scene_has_a_baseline_of_its_own() -> None:
    wishes = expand(["+ablation=consistency", "seed=0,1", "scene=motorcycle,procedural"])
    assert len(wishes) == 8
    for wish in wishes:
        assert wish.condition == ""
        matching = [w for w in wishes if w.label == BASELINE and w.shared == wish.shared]
        assert len(matching) == 1


def test_a_swept_value_is_a_condition_and_a_fixed_one_is_not() -> None:
    wishes = expand(["+ablation=consistency", "train.steps=10,20", "splat.eps=1"])
    assert {wish.condition for wish in wishes} == {"train.steps=10", "train.steps=20"}


def test_a_component_value_is_part_of_the_change_not_of_the_baseline() -> None:
    wishes = expand(["+ablation=consistency", "components.consistency.weight=0.1,0.2"])
    assert [wish.label for wish in wishes] == [
        BASELINE,
        "consistency consistency.weight=0.1",
        "consistency consistency.weight=0.2",
    ]
    assert wishes[0].overrides == []


def test_an_interval_is_refused_by_name() -> None:
    with pytest.raises(XrgsError, match="interval"):
        expand(["seed=interval(0,1)"])


@given(
    st.lists(st.sampled_from("abc"), min_size=1, max_size=3, unique=True),
    st.lists(st.integers(0, 9), min_size=1, max_size=3, unique=True),
)
def test_every_combination_is_there_once(ablations: list[str], seeds: list[int]) -> None:
    wishes = expand([f"+ablation={','.join(ablations)}", f"seed={','.join(map(str, seeds))}"])
    assert len(wishes) == len(set(wishes)) == (len(ablations) + 1) * len(seeds)
    for seed in seeds:
        group = [w for w in wishes if f"seed={seed}" in w.shared]
        assert [w.label for w in group] == [BASELINE, *ablations]
