"""Tests that the axes of a command line become combinations, each with its matching baseline."""

from __future__ import annotations

import pytest
from hydra.errors import HydraException
from hypothesis import given
from hypothesis import strategies as st

from xrgs.errors import XrgsError
from xrgs.store.store import BASELINE
from xrgs.sweep.axes import as_name, effective, expand


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


def values(written: str) -> list[str]:
    """Return the values of an axis in the order of the plan."""
    return [spec.overrides[0].partition("=")[2] for spec in expand([f"key={written}"])]


@pytest.mark.parametrize(
    ("written", "expected"),
    [
        ("range(5,0,-2)", "5 3 1"),
        ("sort(range(5,0,-2))", "1 3 5"),
        ("sort(range(0,5,2),reverse=true)", "4 2 0"),
        ("range(0.1,0.4,0.1)", "0.1 0.2 0.3"),
        ("range(0,1,0.1)", "0.0 0.1 0.2 0.3 0.4 0.5 0.6 0.7 0.8 0.9"),
        ("sort(range(0.1,0.4,0.1),reverse=true)", "0.3 0.2 0.1"),
        ("range(1e-5,4e-5,1e-5)", "1e-05 2e-05 3e-05"),
        ("range(start=1,stop=4)", "1 2 3"),
        ("int(range(0.5,3.5))", "0 1 2"),
        ("sort(choice(3,1,2),reverse=true)", "3 2 1"),
    ],
)
def test_an_axis_has_the_values_that_are_written(written: str, expected: str) -> None:
    assert values(written) == expected.split()


@given(start=st.integers(-99, 99), count=st.integers(1, 30), step=st.integers(1, 99))
def test_a_range_of_decimals_is_that_of_whole_numbers_divided(
    start: int, count: int, step: int
) -> None:
    whole = [start + i * step for i in range(count)]
    stop = start + count * step
    found = values(f"range({start / 100},{stop / 100},{step / 100})")
    assert found == [str(number / 100) for number in whole]
    assert values(f"sort(range({stop - step},{start - 1},{-step}))") == [*map(str, whole)]


@pytest.mark.parametrize("written", ["range(3,3)", "range(1,3),7", "[range(1,3)]"])
def test_an_axis_without_values_and_a_function_in_a_list_are_refused(written: str) -> None:
    with pytest.raises(XrgsError, match=r"this axis has no value|an axis is one list"):
        values(written)


@pytest.mark.parametrize("written", ["range(1,5,0)", "range(0,nan)", "range(0,99999999)"])
def test_a_function_of_wrong_arguments_is_refused(written: str) -> None:
    with pytest.raises(HydraException, match="while evaluating"):
        values(written)


def test_names_that_yaml_reads_as_numbers_stay_names() -> None:
    assert [*map(as_name, ["50", "1e3", "true", "null", "mip"])] == [
        "'50'", "'1e3'", "'true'", "'null'", "mip"
    ]  # fmt: skip
    (_, *cells) = expand(["+ablation=choice(50,[a,b])"])
    assert [cell.overrides for cell in cells] == [["+ablation='50'"], ["+ablation=[a,b]"]]
    assert [cell.label for cell in cells] == ["50", "a+b"]
