"""Tests of what is left to do of a study, in which order, and how long it takes."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import pytest

from xrgs.config import Conf
from xrgs.errors import XrgsError
from xrgs.mixture.paths import TO_TRY
from xrgs.runtime.text import format_duration
from xrgs.splat import backend
from xrgs.store.cell_folder import CellState
from xrgs.store.store import BASELINE
from xrgs.sweep import plan as plan_module
from xrgs.sweep.axes import CellSpec
from xrgs.sweep.estimate import TORCH_SLOWDOWN, Cost
from xrgs.sweep.plan import (
    PlannedCell,
    describe,
    estimated,
    expected_length,
    expected_use,
    identified,
    mixed_prune_rules,
    ready,
    record,
    unchanged,
    will_fail,
    without_kernels,
)
from xrgs.sweep.study import Study


@pytest.fixture
def cell(compose: Callable[..., Conf]) -> Callable[..., PlannedCell]:
    """(id, state, seconds, steps) -> a planned cell."""

    def planned(
        cell_id: str, state: str = "absent", seconds: float | None = None, steps: int = 10
    ) -> PlannedCell:
        conf = compose(f"train.steps={steps}")
        spec = CellSpec(cell_id, "", (), ())
        cost = None if seconds is None else Cost(seconds, 0.0, 1e9, 1e6)
        return PlannedCell(spec, conf, "v", None, cell_id, CellState(state), cost=cost)

    return planned


def configured(cell: PlannedCell, name: str) -> PlannedCell:
    conf = cell.conf
    return replace(cell, conf=replace(conf, splat=replace(conf.splat, backend=name)))


@pytest.mark.parametrize(("retry", "failed"), [(False, set()), (True, {"failed"})])
def test_cells_that_are_done_running_or_tried_are_not_trained(
    cell: Callable[..., PlannedCell], retry: bool, failed: set[str]
) -> None:
    names = ("absent", "corrupt", "done", "failed", "running", "unfinished")
    plan = [cell(name, name) for name in names]
    assert set(ready(plan, (), retry=retry)) == failed | {"absent", "corrupt", "unfinished"}
    assert "absent" not in ready(plan, {"absent"}, retry=retry)
    assert not ready([replace(each, error="no variant") for each in plan], (), retry=retry)


def test_the_longest_cells_come_first_and_unknown_ones_before_them(
    cell: Callable[..., PlannedCell],
) -> None:
    plan = [
        cell("short", seconds=5.0),
        cell("unknown", steps=10),
        cell("long", seconds=50.0),
        cell("unknown and longer", steps=20),
    ]
    ordered = sorted(plan, key=expected_length, reverse=True)
    names = [each.cell_id for each in ordered]
    assert names == ["unknown and longer", "unknown", "long", "short"]


def test_the_plan_says_how_long_the_remaining_training_takes(
    cell: Callable[..., PlannedCell],
) -> None:
    plan = [
        cell("a", "done", 1000.0),
        cell("b", seconds=40.0),
        cell("c", "unfinished", 30.0),
        cell("d"),
        cell("e", "failed", 1000.0),
    ]
    first, *rows = describe(plan).splitlines()
    assert first.startswith("plan: 5 cells, 1 done; left to train, one after another: ~70 s")
    assert "1 cell without an estimate" in first
    assert "~40 s" in rows[1]
    assert "retry=failed" in rows[-1]
    again = [replace(each, conf=replace(each.conf, retry="failed")) for each in plan]
    assert "~18 min" in describe(again).splitlines()[0]


def test_a_scene_that_is_not_placed_gets_what_to_try_once(
    cell: Callable[..., PlannedCell],
) -> None:
    failed = replace(cell("a"), cell_id=None, variant_id=None, error="few views", remembered=True)
    plan = [failed, replace(failed, spec=replace(failed.spec, label="b")), cell("c")]
    text = describe(plan)
    assert [row.partition("(")[2] for row in text.splitlines()[1:3]] == ["few views)", "the same)"]
    assert text.endswith("\n".join(TO_TRY))
    assert text.count(TO_TRY[0]) == 1
    own = replace(failed.conf, variant=replace(failed.conf.variant, poses="sparse/0"))
    other_errors = [replace(failed, remembered=False), replace(failed, conf=own), cell("c")]
    assert TO_TRY[0] not in describe(other_errors)
    baseline = replace(cell("d"), spec=CellSpec(BASELINE, "", (), ()))
    states = [row.state for row in record([*plan, *other_errors, baseline])]
    assert states == ["not placed", "not placed", None, None, None, None, None]


def test_without_kernels_the_plan_says_how_long_torch_takes(
    cell: Callable[..., PlannedCell], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda _: None)
    monkeypatch.delenv(backend.REQUIRE_NATIVE, raising=False)
    unbuilt = replace(
        cell("a"), variant_id=None, cell_id=None, identity=None, cost=Cost(4000.0, 0.0, 0.0, 0.0)
    )
    plan = [
        unbuilt,
        cell("b", seconds=8000.0),
        cell("c", "done", 1e9),
        replace(cell("d", seconds=1e9), error="no variant"),
        configured(cell("e", seconds=1e9), "torch"),
    ]
    line = without_kernels(plan)
    assert "were not built on this machine: torch trains 2 cells" in line
    assert f"~3.3 h instead of {format_duration(12000 / TORCH_SLOWDOWN)}" in line
    assert "pip install" in line
    assert "~3.3 h" in describe(plan[:2]).splitlines()[0]
    unknown = without_kernels([*plan, cell("f")])
    assert "torch trains 3 cells, 30 to 60 times longer" in unknown
    assert without_kernels(plan[2:]) == ""
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: name)
    assert without_kernels(plan) == ""


def test_cells_that_are_not_done_are_estimated(cell: Callable[..., PlannedCell]) -> None:
    class Past:
        def cost(self, conf: Conf, _: str, threads: int) -> Cost:
            return Cost(conf.train.steps / threads, 0.0, 1e9, 1e6)

    plan = [cell("a"), cell("b", "done"), configured(cell("c"), "torch")]
    plan[2] = replace(plan[2], conf=replace(plan[2].conf, threads=5))
    made = estimated(plan, Past(), threads=2)  # type: ignore[arg-type]
    assert [each.seconds for each in made] == [5, None, 2]


def test_the_use_of_memory_and_disk_is_that_of_the_cells_that_are_left(
    cell: Callable[..., PlannedCell], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(plan_module, "usable_memory", lambda: int(2e9))
    plan = [
        replace(cell("a"), cost=Cost(1.0, 0.0, 1.2e9, 30e6)),
        replace(cell("b"), cost=Cost(1.0, 0.0, 8e8, 40e6)),
        replace(cell("c", "done"), cost=Cost(1.0, 0.0, 9e9, 9e9)),
    ]
    assert expected_use(plan, 63) == (
        "estimates from 63 finished cells of this store: a cell takes up to ~1.2 GB of memory, all"
        " of them ~70 MB of disk"
    )
    assert expected_use(plan[2:], 63) == expected_use([cell("d")], 0) == ""
    monkeypatch.setattr(plan_module, "usable_memory", lambda: int(1e9))
    assert "~1.2 GB of memory (more than the 1.0 GB here)," in expected_use(plan, 63)


def test_a_label_whose_cells_have_the_config_of_the_baseline_is_named(
    cell: Callable[..., PlannedCell],
) -> None:
    base = replace(cell("baseline"), cell_id=None)  # its variant is not built
    same = replace(base, spec=CellSpec("idle", "", (), ("x=1",)))
    steps = replace(base.conf, train=replace(base.conf.train, steps=11))
    other = replace(base, spec=CellSpec("other", "", (), ("y=1",)), conf=steps)
    line = "idle changes nothing here: its cells are those of baseline"
    assert unchanged([base, same, other]) == [line]
    built = zip((base, same, other), ("a", "a", "b"), strict=True)
    assert unchanged([replace(one, cell_id=name) for one, name in built]) == [line]
    again = replace(other, spec=CellSpec("more+other", "", (), ("z=1",)))
    assert unchanged([base, other, again]) == [
        "more+other changes nothing here: its cells are those of other"
    ]
    # A key of a component that is off is in no cell's id.
    components = base.conf.components
    consistency = replace(components.consistency, l1=0.5)
    off = replace(base.conf, components=replace(components, consistency=consistency))
    idle = replace(base, spec=CellSpec("l1=0.5", "", (), ("z=1",)), conf=off)
    assert unchanged([base, idle]) == [
        "l1=0.5 changes nothing here: its cells are those of baseline"
    ]
    # What a cell that waits will be is the baseline with a count, which is not known yet.
    spec = CellSpec("count_matched to plus", "", (), ("+ablation=count_matched",))
    control = replace(base, spec=spec, conf=replace(base.conf, matched_to="plus"))
    assert control.waits
    assert unchanged([base, control]) == []


def test_a_condition_with_the_cells_of_another_is_named(cell: Callable[..., PlannedCell]) -> None:
    """As of `variant.jpeg_quality=10,50` without `variant.degradation=jpeg`."""
    plan = [
        replace(cell(name), spec=CellSpec(BASELINE, condition, (condition,), ()))
        for name, condition in (("a", "q=1"), ("a", "q=2"), ("b", "q=3"))
    ]
    line = "q=2 changes nothing here: its cells are those of q=1"
    assert unchanged(plan) == [line]
    assert unchanged([replace(one, cell_id=None) for one in plan]) == []  # not known yet


@pytest.mark.parametrize(
    ("state", "retry", "fails"),
    [("absent", "none", False), ("failed", "none", True), ("failed", "failed", False)],
)
def test_a_dry_run_knows_whether_the_run_would_fail(
    cell: Callable[..., PlannedCell], state: str, retry: str, fails: bool
) -> None:
    one = cell("a", state)
    plan = [replace(one, conf=replace(one.conf, retry=retry))]
    assert will_fail(plan) == fails
    assert will_fail([replace(plan[0], error="no photographs")])


def test_a_cell_whose_lease_is_held_is_running_unless_it_is_done(
    cell: Callable[..., PlannedCell], cells: Any
) -> None:
    own = cells.begin("a")
    one = replace(cell("a"), identity=own.identity())
    assert identified(one, cells.store, {"a": "process 1"}).state.name == "running"
    assert identified(one, cells.store, {}).state.name == "unfinished"
    cells.finish(own)
    assert identified(one, cells.store, {"a": "process 1"}).state.name == "done"


@pytest.mark.parametrize(
    ("history", "checkpoint", "left"),
    [
        ("step,loss\n0,0.5\n29,0.1\n", True, 40.0),  # 30 of 40 steps in 80 s, then 20 s of scoring
        ("step,loss\n0,0.5\n29,0.1\n", False, 100.0),
        (None, True, 100.0),
        ("step,loss\n", True, 100.0),
        ("step,loss\nlast,0.5\n", True, 100.0),
    ],
)
def test_what_a_checkpoint_has_is_not_left_to_train(
    cell: Callable[..., PlannedCell],
    cells: Any,
    history: str | None,
    checkpoint: bool,
    left: float,
) -> None:
    own = cells.begin("a")
    if checkpoint:
        own.checkpoint.touch()
    if history is not None:
        (own.path / "history.csv").write_text(history)
    cost = Cost(100.0, 20.0, 1e9, 1e6)
    one = replace(cell("a", steps=40), identity=own.identity(), cost=cost)
    assert identified(one, cells.store, {}).seconds == left
    own.fail("it raised")  # retry=failed resumes it too
    failed = identified(one, cells.store, {})
    assert (failed.state.name, failed.seconds) == ("failed", left)


def matched(plan: Sequence[PlannedCell]) -> dict[str, PlannedCell]:
    """The cells by their names, with each control's reference among them and planned before it."""
    cells = {cell.name: cell for cell in plan}
    assert len(cells) == len(plan)
    specs = [cell.spec for cell in plan]
    for cell in plan:
        if cell.reference is not None:
            assert specs.index(cell.reference) < specs.index(cell.spec)
    return cells


@pytest.mark.slow
def test_one_command_line_has_arms_and_a_control_for_each(study: Callable[..., Study]) -> None:
    plan = study()._plan(["+ablation=plus,lean,[keep_large,count_matched]", "matched_to=plus,lean"])
    cells = {cell.spec.label: cell for cell in matched(plan).values()}
    assert set(cells) == {
        *(BASELINE, "plus", "lean"),
        *("keep_large+count_matched to plus", "keep_large+count_matched to lean"),
    }
    for name in ("plus", "lean"):
        arm, control = cells[name], cells[f"keep_large+count_matched to {name}"]
        assert (arm.conf.matched_to, arm.waits) == (None, False)
        assert (control.reference, control.waits) == (arm.spec, True)
        assert control.conf.splat.densify.prune_scale3d == 10
        assert control.conf.splat.raster == cells[BASELINE].conf.splat.raster
    assert not mixed_prune_rules(plan)


@pytest.mark.slow
def test_each_replicate_and_condition_is_matched_to_its_own_count(
    study: Callable[..., Study],
) -> None:
    plan = study()._plan(
        [
            *("+ablation=count_matched", "matched_to=densify+consistency", "seed=1,2"),
            *("variant.seed=${seed}", "variant.factor=2,4"),
        ]
    )
    cells = matched(plan)
    assert len(cells) == 3 * 2 * 2, "baseline, reference and control"
    controls = [cell for cell in plan if cell.waits]
    of = {cell.spec: cell for cell in plan}
    for control in controls:
        assert control.reference is not None
        reference = of[control.reference]
        assert control.spec.label == "count_matched to densify+consistency"
        assert reference.spec.label == "densify+consistency"
        assert reference.conf.components.densify.decide == "current_view"
        assert reference.conf.components.consistency.weight > 0
        for cell in (control, reference):
            assert cell.conf.seed == cell.conf.variant.seed
        assert reference.conf.seed == control.conf.seed
        assert reference.conf.variant == control.conf.variant
        assert reference.spec.condition == control.spec.condition
    assert {(c.conf.seed, c.conf.variant.factor) for c in controls} == {
        *((1, 2), (1, 4), (2, 2), (2, 4))
    }


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["+ablation=plus", "matched_to=plus"], "matched_to=plus: no ablation of this sweep"),
        (
            ["+ablation=count_matched", "matched_to=count_matched"],
            "matched_to=count_matched: that cell is matched to xrgs itself",
        ),
        (
            ["+ablation=count_matched", "matched_to=null"],
            "matched_to=null: count_matched takes a number of Gaussians",
        ),
    ],
)
def test_a_count_to_match_without_meaning_is_refused(
    study: Callable[..., Study], arguments: list[str], message: str
) -> None:
    made = study()
    with pytest.raises(XrgsError, match=f"^{message}"):
        made._plan(arguments)


def test_null_asks_for_no_control(study: Callable[..., Study]) -> None:
    made = study()
    assert made._plan(["+ablation=plus", "matched_to=null"]) == made._plan(["+ablation=plus"])


def test_a_count_to_match_of_every_cell_of_a_file_is_refused(study: Callable[..., Study]) -> None:
    made = study("matched_to=plus")
    with pytest.raises(XrgsError, match=r"^matched_to=plus: the baseline can't be matched"):
        made._plan(["+ablation=plus"])


@pytest.mark.slow
def test_a_control_with_another_prune_rule_is_named_once(study: Callable[..., Study]) -> None:
    base = "count_matched,[keep_large,count_matched]"
    plan = study()._plan([f"+ablation={base}", "matched_to=keep_large", "seed=0,1"])
    (line,) = mixed_prune_rules(plan)
    assert line.startswith(
        "count_matched to keep_large: splat.densify.prune_scale3d is 0.1 here and 10 in keep_large"
    )
