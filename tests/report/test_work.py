"""What a report says that training did and left out, from histories and totals written by hand."""

import math
from typing import Any

import pytest

from xrgs.evaluation.metrics import METRICS
from xrgs.report.compare import compare
from xrgs.report.work import skipped, totals, totals_table

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
2,b,0.3,11,1,2,5,0,3,0.75
"""


def _totals(made: Any) -> Any:
    sweep = made.read()
    return totals(sweep.cells, sweep.done)


def test_counts_are_the_last_rows_and_notes_are_means(made: Any) -> None:
    made.add(history=_BASELINE)
    made.add("loss_weighting", history=_NOTED)
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
    assert totals_table(found, ["baseline", "mip"], "").rows == ()


WORK = {
    "views": 20,
    "gaussians": 1000,
    "gaussians_visible": 750,
    "pixels": 8000,
    "pixels_photograph": 10_000,
    "pixels_left_out": 2000,
    "pairs": 40 * 10**9,
    "pairs_visible": 30 * 10**9,
    "pairs_in_tiles": 4 * 10**9,
    "sh_coefficients": 16_000,
    "sh_coefficients_left_out": 4000,
}
STAGES = {"forward": 50.0, "backward": 24.0, "optimizer": 6.0, "densification": 20.0}
SUMMARY = {"work": WORK, "stage_seconds": STAGES}
HISTORY = "step,steps_HR,skipped_backward,skipped_shN\n0,1,0,0\n499,500,{skipped},400\n"


def found(made: Any) -> Any:
    sweep = made.read()
    return skipped(compare(sweep.cells, METRICS).cells, sweep.done)


def by_kind(made: Any, label: str) -> dict[str, tuple[float, ...]]:
    rows = found(made)
    return {
        row.kind: (row.number, row.share, row.cost, row.cost_share)
        for row in rows[rows["label"] == label].itertuples()
    }


def test_each_kind_has_number_share_and_cost(made: Any) -> None:
    """The baseline takes 500 steps, 100 s and 10^9 evaluations."""
    made.add(summary=SUMMARY)
    made.add(
        "lean",
        summary=SUMMARY | {"work": WORK | {"views": 15}, "steps": 400},
        history=HISTORY.format(skipped=100),
    )
    kinds = by_kind(made, "lean")
    assert kinds["steps"] == pytest.approx((100, 100 / 500, 100 * 100 / 400, 0.25))
    assert kinds["views"] == (5, 0.25, 0, 0)
    # 300 backward passes and updates took 30 s.
    assert kinds["skipped_backward"] == pytest.approx((100, 0.25, 10.0, 0.1))
    assert kinds["skipped_shN"][:2] == (400, 1.0)
    assert math.isnan(kinds["skipped_shN"][2])
    assert kinds["pixels"] == pytest.approx((2000, 0.2, 0.25e9, 0.25))
    assert kinds["gaussians"] == pytest.approx((250, 0.25, 10e9, 10))
    assert kinds["tiles"] == pytest.approx((26e9, 26 / 30, 26e9, 26))
    assert kinds["blocks"] == pytest.approx((3e9, 0.75, 3e9, 3))
    assert kinds["sh"][:2] == (4000, 0.25)
    assert math.isnan(kinds["sh"][2])
    baseline = by_kind(made, "baseline")
    assert baseline["steps"][0] == baseline["views"][0] == 0
    assert "skipped_backward" not in baseline


def test_what_takes_more_or_skips_all_has_no_share(made: Any) -> None:
    made.add(summary=SUMMARY, history=HISTORY.format(skipped=500))
    made.add("long", summary=SUMMARY | {"work": WORK | {"views": 21}, "steps": 600})
    kinds = by_kind(made, "long")
    assert kinds["steps"][0] == kinds["views"][0] == 0
    assert math.isnan(by_kind(made, "baseline")["skipped_backward"][2]), "no mean of them"


def test_cells_of_older_versions_have_counts_alone(made: Any) -> None:
    made.add()
    made.add("plus", summary=SUMMARY)
    assert set(by_kind(made, "baseline")) == {"steps"}
    assert "views" not in by_kind(made, "plus")


def test_malformed_totals_cost_their_cell_alone(made: Any) -> None:
    made.add(summary=SUMMARY)
    made.add("lean", summary={"work": {"views": "many"}})
    cells = made.read().cells.set_index("label")
    assert cells["state"].to_dict() == {"baseline": "done", "lean": "corrupt"}
    assert "damaged: summary.json: work" in cells.loc["lean", "reason"]
