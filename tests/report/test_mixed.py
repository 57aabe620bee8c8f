"""Warnings of cells in one table that were trained with other settings or other code."""

from typing import Any

from tests.report.conftest import MadeStore
from xrgs.evaluation.metrics import METRICS
from xrgs.report.collect import Choice, ReportStore, read_cells
from xrgs.report.compare import compare
from xrgs.report.mixed import fewer_replicates, other_code, other_settings


def warnings(made: MadeStore, sweep_ids: list[str], *scenes: str) -> list[str]:
    store = ReportStore(made.store.path)
    commands, rows = store.sweep_records(sweep_ids)
    sweep = read_cells(store, commands, Choice(scenes).rows(rows, "baseline"))
    return [*other_settings(sweep, compare(sweep.cells, METRICS)), *other_code(sweep)]


def test_scenes_and_replicates_of_other_settings_or_code_are_named(made: Any) -> None:
    short = {"train": {"steps": 500}, "code": {"core": "a", "order": "x"}}
    long = {"train": {"steps": 600}, "code": {"core": "b", "order": "y"}}
    for scene, seed, of in (("fern", 0, short), ("horns", 0, long), ("room", 0, short)):
        made.add(scene=scene, seed=seed, **of)
    made.add(scene="room", seed=1, **long)
    sweep_id = made.write()
    assert warnings(made, [sweep_id]) == [
        "Means of baseline are of cells with different settings: train.steps 500 (fern, room 0/0),"
        " 600 (horns, room 0/1).",
        "The cells were trained by different code, and a change may be the code's. The first cells"
        " of each version: core of cell00000, cell00001.",
    ]
    assert warnings(made, [sweep_id], "horns") == []


def test_a_baseline_of_another_sweep_with_other_settings_is_named(made: Any) -> None:
    made.add(train={"steps": 500})
    first = made.write(("+ablation=plus", "train.steps=500"))
    for scene in ("fern", "horns"):
        made.add("lean", scene=scene, train={"steps": 600})
        made.rows[-1]["baseline_id"] = None  # its sweep has no baseline
    made.rows = made.rows[1:]
    same = made.write(("+ablation=lean", "train.steps=500", "baseline=false"))
    assert warnings(made, [first, same]) == []  # the ablation sets the steps
    other = made.write(("+ablation=lean", "+sweeps=mine", "baseline=false"))
    (warning,) = warnings(made, [first, other])
    assert "lean is compared with the baseline of a sweep with another command" in warning
    assert "they differ in train.steps 600, 500:" in warning


def test_labels_with_other_replicates_are_named(made: Any) -> None:
    for scene, seeds in (("fern", (0, 1)), ("horns", (0,))):
        for seed in seeds:
            made.add(scene=scene, seed=seed)
    made.add("plus", scene="horns")
    assert fewer_replicates(compare(made.read().cells, METRICS)) == []
    made.add("plus", state="failed")
    made.add("plus", seed=1)
    made.add("lean", values={"lpips": None})
    made.add("lean", seed=1)
    (warning,) = fewer_replicates(compare(made.read().cells, METRICS))
    assert "are lacking: plus on fern (1 of 2), LPIPS of lean on fern (1 of 2). Changes" in warning
