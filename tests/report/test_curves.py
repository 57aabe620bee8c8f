"""Quality during training and the time to the baseline's quality, from curves written by hand."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd
import pytest

from xrgs.evaluation.metrics import METRICS
from xrgs.report.collect import CURVE_COLUMNS
from xrgs.report.compare import compare
from xrgs.report.curves import (
    first_reaches,
    joined,
    means_over_runs,
    means_over_scenes,
    table,
    times,
)


def quality(psnr: list[float], seconds: float = 10.0, evaluations: float = 1e8) -> str:
    """A cell's quality.csv: an evaluation every 100 steps, each after so much time and work."""
    rows = [
        f"{100 * n},{seconds * n},{evaluations * n:.0f},{1000 * n},0.5,0.7,{value}"
        for n, value in enumerate(psnr, start=1)
    ]
    header = "step,seconds,evaluations,gaussians,lpips,ssim,psnr"
    return "\n".join([header, *rows]) + "\n"


BASELINE = quality([15.0, 17.0, 18.0, 19.0], seconds=20, evaluations=2e8)
"""Of a cell that ends at 20 dB, after 500 steps, 100 s and 10^9 evaluations."""


def read(made: Any) -> Any:
    sweep = made.read()
    return replace(sweep, cells=compare(sweep.cells, METRICS).cells)


@pytest.mark.parametrize(
    ("psnr", "target", "expected"),
    [
        ([20.0, 22.0, 21.0], 21.5, 17.5),
        ([20.0, 22.0], 19.0, 10.0),  # before the first evaluation
        ([20.0, 19.0, 23.0, 18.0], 21.0, 25.0),  # after opacities were reset
        ([20.0, math.nan, 22.0], 21.0, 20.0),  # between the evaluations that have a number
        ([20.0, 22.0], 22.1, math.nan),
        ([], 1.0, math.nan),
        ([20.0, math.inf], 21.0, 10.0),
    ],
)
def test_a_target_is_reached_between_evaluations(
    psnr: list[float], target: float, expected: float
) -> None:
    seconds = [10.0 * n for n in range(1, len(psnr) + 1)]
    assert first_reaches(psnr, seconds, target) == pytest.approx(expected, nan_ok=True)


def test_a_curve_ends_with_the_trained_cell(made: Any) -> None:
    cell = made.add(quality=BASELINE)
    made.add("plain")
    sweep = read(made)
    curves = joined(sweep.cells, sweep.done)
    assert list(curves["step"]) == [100, 200, 300, 400, 500]
    assert set(curves["cell_id"]) == {cell.id}, "a cell without evaluations has no curve"
    last = curves.iloc[-1]
    assert (last["seconds"], last["evaluations"], last["gaussians"]) == (100.0, 1e9, 5000)
    assert last["psnr"] == pytest.approx(20.0)
    assert last["lpips"] == pytest.approx(0.25)


def study(made: Any) -> Any:
    """The baseline, an ablation that passes it and one that does not, on two scenes.

    All baselines end at 20 dB. `fast` is there at 20 and 30 s of 100 (fern), and at 50 s (horns).
    """
    for seed, psnr in ((0, [18.0, 20.0, 22.0]), (1, [18.0, 19.0, 20.0])):
        made.add(quality=BASELINE, seed=seed)
        made.add("fast", quality=quality(psnr), seed=seed)
        made.add("slow", quality=quality([18.0, 19.0]), values={"psnr": 20.5 - seed}, seed=seed)
    made.add(quality=BASELINE, scene="horns")
    made.add(
        "fast",
        quality=quality([18.0, 19.0], seconds=33.0),
        scene="horns",
        values={"psnr": 21.0, "training_time_s": 34.0 + 50.0},
        factors={},
    )
    return made


def test_times_are_shares_of_the_paired_baseline(made: Any) -> None:
    sweep = read(study(made))
    found = times(sweep.cells, sweep.done).set_index(["scene", "label", "seed"])
    assert found["target"].to_numpy() == pytest.approx(20.0)
    assert found.loc[("fern", "fast", 0), "seconds"] == pytest.approx(20.0)
    assert found.loc[("fern", "fast", 1), "seconds"] == pytest.approx(30.0)
    assert found.loc[("fern", "fast", 1), "seconds_share"] == pytest.approx(0.3)
    assert found.loc[("fern", "fast", 1), "evaluations_share"] == pytest.approx(0.3)
    assert found.loc[("fern", "fast", 1), "evaluations_own_share"] == pytest.approx(0.3)
    # From 66 s at 19 dB to 84 s at 21 dB.
    assert found.loc[("horns", "fast", 0), "seconds"] == pytest.approx(75.0)
    # From 20 s at 19 dB to the end at 100 s with 20.5 dB.
    assert found.loc[("fern", "slow", 0), "seconds"] == pytest.approx(20 + 80 / 1.5)
    assert found["seconds"].isna().sum() == 1
    assert found["seconds"].isna()[("fern", "slow", 1)]
    assert found.loc[("fern", "baseline", 0), "seconds_share"] == pytest.approx(1.0)


def test_the_table_says_what_was_not_reached(made: Any) -> None:
    sweep = read(study(made))
    labels = ["baseline", "fast", "slow", "unknown"]
    made_of = table(times(sweep.cells, sweep.done), labels, "", "baseline")
    rows = {row[:2]: row[2:] for row in made_of.rows}
    not_all = "not reached 1 of 2"
    assert rows["fern", "Time, s"] == ("100.0", "25.0", not_all, "")
    assert rows["fern", "Time, % of baseline's whole training"] == ("100", "25", not_all, "")
    assert rows["fern", "Alpha evaluations, 10^9"] == ("1", "0.25", not_all, "")
    assert rows["horns", "Time, s"] == ("100.0", "75.0", "", "")
    mean = rows["mean over scenes", "Time, % of baseline's whole training"]
    assert mean == ("100", "50", "not reached", "")  # 25 and 75: each scene counts once
    assert len(rows) == 6 + 6 + 4
    assert next(iter(rows))[1] == "Alpha evaluations, 10^9", "the measure of work"


def test_a_base_that_falls_has_its_own_first_passage_beside_it(made: Any) -> None:
    """The base has its final 20 dB after 30 of 100 s and 3 of 10 evaluations, and falls again."""
    made.add(quality=quality([15.0, 19.0, 20.0, 22.0, 18.0], seconds=10, evaluations=1e8))
    made.add("fast", quality=quality([19.0, 21.0], seconds=10, evaluations=2e8))
    sweep = read(made)
    found = times(sweep.cells, sweep.done).set_index("label")
    assert found.loc["baseline", "seconds_share"] == pytest.approx(0.3)
    assert found.loc["baseline", "seconds_own_share"] == pytest.approx(1.0)
    assert found.loc["fast", "seconds_share"] == pytest.approx(0.15)
    assert found.loc["fast", "seconds_own_share"] == pytest.approx(0.5)
    assert found.loc["fast", "evaluations_own_share"] == pytest.approx(1.0)


def test_a_time_of_another_machine_is_no_share_of_the_baselines(made: Any) -> None:
    made.add(scene="failed", state="failed")
    made.add("fast", scene="failed", quality=BASELINE)  # it has no target
    made.add(values={"psnr": 20.0, "training_time_s": 100.0}, quality=BASELINE)
    made.add("fast", values={"psnr": 22.0}, quality=quality([18.0, 21.0]), cpu="another")
    sweep = read(made)
    found = times(sweep.cells, sweep.done).set_index("label")
    assert set(found["scene"]) == {"fern"}
    assert found.loc["fast", "seconds"] == pytest.approx(10 + 10 * 2 / 3)  # from 18 dB to 21 dB
    assert found["seconds_share"].isna().to_dict() == {"baseline": False, "fast": True}
    assert not found["evaluations_share"].isna().any()
    made_of = table(times(sweep.cells, sweep.done), ["fast"], "", "baseline")
    rows = {row[1]: row[2] for row in made_of.rows}
    assert rows["Time, s"] == "16.7"
    assert rows["Time, % of baseline's whole training"] == "n/a"
    assert rows["Time, % of baseline's own first passage"] == "n/a"


def curve(label: str, scene: str, psnr: dict[int, float], seed: int = 0) -> list[dict[str, Any]]:
    keys = {"label": label, "scene": scene, "seed": seed, "condition": ""}
    return [
        keys | dict.fromkeys(CURVE_COLUMNS, float(step)) | {"psnr": value}
        for step, value in psnr.items()
    ]


def test_means_are_over_what_all_have() -> None:
    rows = [
        *curve("baseline", "fern", {100: 10.0, 200: 12.0}),
        *curve("baseline", "fern", {100: 14.0, 200: 16.0, 300: 18.0}, seed=1),
        *curve("baseline", "horns", {100: 20.0, 200: math.nan}),
        *curve("baseline", "leaves", {100: 0.0}),
        *curve("plus", "fern", {100: 15.0}),
        *curve("plus", "horns", {100: 25.0}),
    ]
    scenes = means_over_runs(pd.DataFrame(rows), "")
    found = scenes.set_index(["label", "scene", "step"])["psnr"].to_dict()
    assert found["baseline", "fern", 100] == 12.0
    assert found["baseline", "fern", 200] == 14.0
    assert ("baseline", "fern", 300) not in found, "one of two runs has it"
    assert np.isnan(found["baseline", "horns", 200])
    means = means_over_scenes(scenes).set_index(["label", "step"])["psnr"].to_dict()
    assert means["baseline", 100] == 16.0, "leaves has no plus"
    assert np.isnan(means["baseline", 200])
    assert means["plus", 100] == 20.0


def test_a_malformed_curve_costs_its_cell_alone(made: Any) -> None:
    made.add(quality=BASELINE)
    made.add("plus", quality="step,seconds\n1,2\n")
    made.add("lean", quality="step,seconds,evaluations,gaussians\n1,x,3,4\n")
    made.add("mip", quality=BASELINE)
    cells = made.read().cells.set_index("label")
    states = {"baseline": "done", "plus": "corrupt", "lean": "corrupt", "mip": "done"}
    assert cells["state"].to_dict() == states
    for label in ("plus", "lean"):
        assert "damaged: quality.csv" in cells.loc[label, "reason"]
