"""What a report says training did, from histories written by hand."""

import math
from typing import Any

from xrgs.report.training import table, totals

_BASELINE = """\
step,view,loss,gaussians,steps_HR,steps_LR,split,reset
0,a,0.5,10,1,0,0,0
1,b,0.4,12,1,1,7,0
2,a,0.3,15,2,1,9,0
"""
_NOTED = """\
step,view,loss,gaussians,steps_HR,steps_LR,split,reset,grown_HR,weighting.LR
0,a,0.5,10,1,0,0,0,0,
1,b,0.4,10,1,1,1,0,0,0.25
2,b,0.3,11,1,2,{split},0,3,0.75
"""


def _totals(made: Any) -> Any:
    sweep = made.read()
    return totals(sweep.cells, sweep.training)


def test_counts_are_the_last_rows_and_notes_are_means(made: Any) -> None:
    made.add(history=_BASELINE)
    made.add("loss_weighting", history=_NOTED.format(split=5))
    baseline, changed = (row for _, row in _totals(made).iterrows())
    assert (baseline["steps_HR"], baseline["steps_LR"], baseline["split"]) == (2, 1, 9)
    assert (changed["steps_HR"], changed["grown_HR"], changed["weighting.LR"]) == (1, 3, 0.5)
    assert math.isnan(baseline["grown_HR"]), "the baseline tells no groups apart"
    assert not {"step", "view", "loss", "gaussians"} & set(changed.index)


def test_a_cell_that_failed_and_one_without_steps_have_no_numbers(made: Any) -> None:
    made.add(history="step,view,loss,gaussians,steps_HR\n")
    made.add("mip", state="failed")
    found = _totals(made)
    assert list(found["label"]) == ["baseline"]
    assert table(found, ["baseline", "mip"], "").rows == ()


def test_the_table_has_means_over_seeds_scene_by_scene(made: Any) -> None:
    for seed, split in ((0, 1000), (1, 2001)):
        made.add(history=_BASELINE, seed=seed)
        made.add("loss_weighting", history=_NOTED.format(split=split), seed=seed)
    made.add(history=_BASELINE, scene="horns")
    rows = table(_totals(made), ["baseline", "loss_weighting"], "").rows
    assert rows == (
        ("fern", "Steps on HR views", "2", "1"),
        ("fern", "Steps on LR views", "1", "2"),
        ("fern", "Gaussians split", "9", "1,500"),
        ("fern", "Opacities reset", "0", "0"),
        ("fern", "grown HR", "", "3"),
        ("fern", "weighting.LR", "", "0.5"),
        ("horns", "Steps on HR views", "2", ""),
        ("horns", "Steps on LR views", "1", ""),
        ("horns", "Gaussians split", "9", ""),
        ("horns", "Opacities reset", "0", ""),
    )


def test_conditions_are_tables_of_their_own(made: Any) -> None:
    made.add(history=_BASELINE)
    made.add(history=_NOTED.format(split=5), condition="variant.factor=3")
    found = _totals(made)
    of_all = {name: table(found, ["baseline"], name).rows for name in ("", "variant.factor=3")}
    assert ("fern", "Gaussians split", "9") in of_all[""]
    assert ("fern", "Gaussians split", "5") in of_all["variant.factor=3"]
