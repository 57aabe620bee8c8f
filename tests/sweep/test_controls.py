"""Tests of the cells that take a number of Gaussians from another cell: names, pairs, refusals."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import pytest

from xrgs.errors import XrgsError
from xrgs.store.store import BASELINE
from xrgs.sweep.plan import PlannedCell, mixed_prune_rules
from xrgs.sweep.study import Study


def matched(plan: Sequence[PlannedCell]) -> dict[str, PlannedCell]:
    """The cells by their names, with each control's reference among them and planned before it."""
    cells = {cell.name: cell for cell in plan}
    assert len(cells) == len(plan)
    specs = [cell.spec for cell in plan]
    for cell in plan:
        if cell.reference is not None:
            assert specs.index(cell.reference) < specs.index(cell.spec)
    return cells


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


def test_a_control_with_another_prune_rule_is_named_once(study: Callable[..., Study]) -> None:
    base = "count_matched,[keep_large,count_matched]"
    plan = study()._plan([f"+ablation={base}", "matched_to=keep_large", "seed=0,1"])
    (line,) = mixed_prune_rules(plan)
    assert line.startswith(
        "count_matched to keep_large: splat.densify.prune_scale3d is 0.1 here and 10 in keep_large"
    )
