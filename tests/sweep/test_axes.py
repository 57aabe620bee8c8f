"""Tests that the axes of a command line become combinations, each with its matching baseline."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from xrgs.errors import XrgsError
from xrgs.store.store import BASELINE
from xrgs.sweep.axes import effective, expand


def labels_and_conditions(*arguments: str) -> list[tuple[str, str]]:
    return [(spec.label, spec.condition) for spec in expand(arguments)]


@pytest.mark.parametrize(
    ("argument", "labels"),
    [
        ("seed=0", []),
        ("+ablation=consistency", ["consistency"]),
        ("ablation=consistency", ["consistency"]),
        ("+ablation=baseline,consistency", ["consistency"]),
        ("+ablation=[loss_weighting, 'consistency']", ["loss_weighting+consistency"]),
    ],
)
def test_each_ablation_has_its_label_and_brings_the_baseline(
    argument: str, labels: list[str]
) -> None:
    assert labels_and_conditions(argument) == [(label, "") for label in (BASELINE, *labels)]


def test_a_cell_has_the_overrides_of_its_combination() -> None:
    baseline, cell = expand(["+ablation=consistency", "seed=3", "train.steps=10"])
    assert (baseline.shared, baseline.changes) == (("seed=3", "train.steps=10"), ())
    assert (cell.shared, cell.changes) == (baseline.shared, ("+ablation=consistency",))
    assert cell.overrides == ["seed=3", "train.steps=10", "+ablation=consistency"]


def test_a_count_to_match_is_a_change_of_the_program_and_no_part_of_its_label() -> None:
    baseline, *cells = expand(["+ablation=count_matched", "matched_to=plus,lean"])
    assert (baseline.label, baseline.shared, baseline.matched_to) == (BASELINE, (), None)
    assert [cell.label for cell in cells] == ["count_matched"] * 2
    assert [cell.matched_to for cell in cells] == ["plus", "lean"]
    for cell in cells:
        assert cell.shared == ()
        assert cell.without_match.changes == ("+ablation=count_matched",)


@pytest.mark.parametrize("ablation", [[], ["+ablation=baseline"]])
def test_a_baseline_without_its_count_to_match_is_the_baseline(ablation: list[str]) -> None:
    baseline, matched = expand([*ablation, "matched_to=plus", "seed=1"])
    assert matched.matched_to == "plus"
    assert matched.without_match == baseline


def test_what_a_later_argument_replaces_is_left_out() -> None:
    file = ["scene=a,b", "+ablation=mip,absgrad", "seed=0,1"]
    typed = ["+sweeps=study", "+ablation=[mip, absgrad]", "seed=2", "threads=1"]
    kept = ["scene=a,b", "+ablation=[mip, absgrad]", "seed=2", "+sweeps=study", "threads=1"]
    assert effective([*file, *typed]) == kept
    assert expand(kept) == expand([*file, *typed])


def test_each_seed_and_scene_has_a_baseline_of_its_own() -> None:
    specs = expand(["+ablation=consistency", "seed=0,1", "scene=motorcycle,procedural"])
    assert len(specs) == 8
    for spec in specs:
        assert spec.condition == ""
        matching = [s for s in specs if s.label == BASELINE and s.shared == spec.shared]
        assert len(matching) == 1


@pytest.mark.parametrize(
    ("axis", "is_condition"),
    [
        ("train.steps=10,20", True),
        ("variant.sfm.seed=0,1", True),
        ("+scenery.path=a,b", True),
        ("scene.path=a,b", False),
        ("seed=0,1", False),
        ("variant.seed=0,1", False),
    ],
)
def test_a_swept_value_but_of_the_scene_and_the_replicate_is_a_condition(
    axis: str, is_condition: bool
) -> None:
    """Tables have columns of their own for these."""
    specs = expand(["+ablation=consistency", axis, "splat.eps=1"])
    assert len(specs) == 4
    key, _, values = axis.lstrip("+").partition("=")
    conditions = {f"{key}={value}" for value in values.split(",")} if is_condition else {""}
    assert {spec.condition for spec in specs} == conditions
    assert len({spec.shared for spec in specs}) == 2


def test_a_component_value_belongs_to_the_change_and_not_to_the_baseline() -> None:
    specs = expand(["+ablation=consistency", "components.consistency.weight=0.1,0.2"])
    assert [spec.label for spec in specs] == [
        BASELINE,
        "consistency consistency.weight=0.1",
        "consistency consistency.weight=0.2",
    ]
    assert specs[0].overrides == []
    with pytest.raises(XrgsError, match=r"interval\(0,1\): an axis must be a list"):
        expand(["seed=interval(0,1)"])


@given(
    st.lists(st.sampled_from("abc"), min_size=1, max_size=3, unique=True),
    st.lists(st.integers(0, 9), min_size=1, max_size=3, unique=True),
)
def test_every_combination_is_planned_once(ablations: list[str], seeds: list[int]) -> None:
    specs = expand([f"+ablation={','.join(ablations)}", f"seed={','.join(map(str, seeds))}"])
    assert len(specs) == len(set(specs)) == (len(ablations) + 1) * len(seeds)
    for seed in seeds:
        group = [spec for spec in specs if f"seed={seed}" in spec.shared]
        assert [spec.label for spec in group] == [BASELINE, *ablations]
