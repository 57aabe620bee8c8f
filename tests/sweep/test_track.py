"""What is tracked, against the readers of TensorBoard, MLflow and Python's csv."""

from __future__ import annotations

import csv
import json
import math
from pathlib import Path
from typing import Any

import pytest
from mlflow import MlflowClient
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from xrgs.errors import XrgsError
from xrgs.experiment.attempts import begin_attempt
from xrgs.experiment.store import Store
from xrgs.sweep import track

CONFIG = {
    "scene": {"name": "fern", "path": None},
    "splat": {"raster": {"background": [0.0, 0.5, 0.0]}},
    "train": {"steps": 20},
    "seed": 3,
    "store": "/elsewhere",
}
#: What is tracked of it: the groups that can change a number, lists and None as texts.
SETTINGS = {
    "scene.name": "fern",
    "scene.path": "None",
    "splat.raster.background": "[0.0, 0.5, 0.0]",
    "train.steps": 20,
}
HISTORY = "step,view,loss,mip.sigma\n0,a,0.5,\n10,b,0.25,0.125\n"
QUALITY = "step,seconds,psnr\n10,1.5,18.5\n"
EXPECTED = {
    "history/loss": [(0, 0.5), (10, 0.25)],
    "history/mip.sigma": [(10, 0.125)],
    "quality/seconds": [(10, 1.5)],
    "quality/psnr": [(10, 18.5)],
    "score/gaussians": [(20, 7.0)],
    "score/psnr": [(20, 25.25)],
}


def add(store: Store, cell_id: str, label: str, *, quality: bool = True) -> dict[str, Any]:
    cell = store.cell(cell_id)
    begin_attempt(cell, CONFIG, {"variant": "v", "seed": 3})
    (cell.path / "scores.csv").write_text("view,psnr,lpips\na,20.5,\nb,30.0,\n")
    (cell.path / "history.csv").write_text(HISTORY)
    (cell.path / "summary.json").write_text('{"gaussians": 7, "steps": 20}')
    if quality:
        (cell.path / "quality.csv").write_text(QUALITY)
    cell.finish(["a", "b"], 1)
    names = {"cell_id": cell_id, "label": label, "condition": "", "scene": "fern"}
    return names | {"variant_seed": 0, "seed": 3}


@pytest.fixture
def swept(tmp_path: Path) -> tuple[Store, str]:
    """A store, and a sweep of two finished cells, a failed one and one that was never planned."""
    store = Store(tmp_path / "s")
    store.prepare()
    rows = [add(store, "abc", "baseline"), add(store, "def", "=cmd|'x'\x1b", quality=False)]
    failed = store.cell("bad")
    begin_attempt(failed, CONFIG, {})
    failed.fail("out of memory")
    rows += [rows[0] | {"cell_id": "bad"}, rows[0] | {"cell_id": None}]
    return store, store.write_sweep([], rows)


def test_a_table_has_every_value(
    swept: tuple[Store, str], capsys: pytest.CaptureFixture[str]
) -> None:
    store, sweep_id = swept
    track.track("csv", store, sweep_id)
    file = store.path / "tracking" / f"{sweep_id}.csv"
    assert capsys.readouterr().err == f"track=csv: {file}\n"
    rows = list(csv.DictReader(file.read_text().splitlines()))
    assert {row["cell_id"] for row in rows} == {"abc", "def"}
    found: dict[str, list[tuple[int, float]]] = {}
    for row in rows:
        if row["cell_id"] == "abc":
            found.setdefault(row["series"], []).append((int(row["step"]), float(row["value"])))
    assert found == EXPECTED
    assert rows[0].keys() == {"cell_id", *track._NAMES, "series", "step", "value"}
    assert {row["label"] for row in rows} == {"baseline", "'=cmd|'x'"}, "no formula, no escape"


def test_tensorboard_reads_each_cell(swept: tuple[Store, str]) -> None:
    store, sweep_id = swept
    track.track("tensorboard", store, sweep_id)
    home = store.path / "tracking" / "tensorboard"
    runs = sorted(home.iterdir())
    assert len(runs) == 2
    (run,) = [run for run in runs if run.name == "fern--baseline--seed-0-3--abc"]
    events = EventAccumulator(str(run)).Reload()
    found = {
        name: [(event.step, event.value) for event in events.Scalars(name)]
        for name in events.Tags()["scalars"]
    }
    assert found == EXPECTED
    plugin = events.summary_metadata["_hparams_/session_start_info"].plugin_data.content
    assert b"train.steps" in plugin
    before = {file: file.stat().st_mtime_ns for file in home.rglob("*")}
    track.track("tensorboard", store, sweep_id)
    assert {file: file.stat().st_mtime_ns for file in home.rglob("*")} == before


@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # MLflow's own, of SQLAlchemy 2.1
def test_mlflow_reads_each_cell(swept: tuple[Store, str], monkeypatch: pytest.MonkeyPatch) -> None:
    store, sweep_id = swept
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
    for _ in range(2):  # the second time finds them
        track.track("mlflow", store, sweep_id)
    client = MlflowClient(f"sqlite:///{store.path}/tracking/mlflow.db")
    (experiment,) = [e for e in client.search_experiments() if e.name == "xrgs"]
    runs = {run.data.tags["cell_id"]: run for run in client.search_runs([experiment.experiment_id])}
    assert runs.keys() == {"abc", "def"}
    run = runs["abc"]
    found = {
        name: [(m.step, m.value) for m in client.get_metric_history(run.info.run_id, name)]
        for name in run.data.metrics
    }
    assert found == EXPECTED
    assert run.data.params == {key: str(value) for key, value in SETTINGS.items()}
    assert run.data.tags["label"] == "baseline"
    assert run.info.status == "FINISHED"


@pytest.mark.parametrize("kind", ["csv", "tensorboard", "mlflow"])
def test_a_failure_is_a_warning(
    swept: tuple[Store, str],
    kind: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    store, sweep_id = swept

    def fail(*_: object) -> str:
        raise ConnectionError("no server\x1b[31m")

    monkeypatch.setitem(track._WRITERS, kind, fail)
    track.track(kind, store, sweep_id)
    err = capsys.readouterr().err
    assert err == f"track={kind}: ConnectionError: no server [31m; the cells are in the store\n"


def test_a_link_leads_nowhere(
    swept: tuple[Store, str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    store, sweep_id = swept
    (tmp_path / "outside").mkdir()
    (store.path / "tracking").symlink_to(tmp_path / "outside")
    track.track("tensorboard", store, sweep_id)
    assert "track=tensorboard: " in capsys.readouterr().err
    (store.path / "tracking").unlink()
    (store.path / "tracking").mkdir()
    (store.path / "tracking" / "mlflow.db").symlink_to(tmp_path / "outside" / "file")
    track.track("mlflow", store, sweep_id)
    assert "mlflow.db is not a regular file" in capsys.readouterr().err
    assert not list((tmp_path / "outside").iterdir())


def test_a_cell_that_can_not_be_read_is_left_out(
    swept: tuple[Store, str], capsys: pytest.CaptureFixture[str]
) -> None:
    store, sweep_id = swept
    status = store.path / "cells" / "abc" / "status.json"
    history = store.path / "cells" / "abc" / "history.csv"
    text = HISTORY.replace("0.25", "1e99")  # of the same size, so that the cell is still done
    history.write_text(text)
    assert json.loads(status.read_text())["files"]["history.csv"]["bytes"] == len(text)
    track.track("csv", store, sweep_id)
    assert "abc: it is left out of what is tracked: " in capsys.readouterr().err
    rows = (store.path / "tracking" / f"{sweep_id}.csv").read_text()
    assert "def" in rows
    assert "abc" not in rows


def test_no_tracking_writes_nothing(swept: tuple[Store, str]) -> None:
    store, sweep_id = swept
    track.track("none", store, sweep_id)
    assert not (store.path / "tracking").exists()


def test_what_can_not_be_tracked_is_said_before_training(monkeypatch: pytest.MonkeyPatch) -> None:
    for kind in track.KINDS:
        track.check(kind)
    with pytest.raises(XrgsError, match="track=wandb: must be one of none, csv, tensorboard, mlf"):
        track.check("wandb")
    monkeypatch.setattr(track, "find_spec", lambda _: None)
    with pytest.raises(XrgsError, match=r"track=mlflow: .* pip install 'xrgs\[mlflow\]'"):
        track.check("mlflow")
    track.check("csv")


def test_no_value_is_nan(swept: tuple[Store, str]) -> None:
    store, _ = swept
    names = dict.fromkeys(track._NAMES, "x")
    run = track.run_of(store.cell("abc"), names)
    assert not any(math.isnan(point.value) for point in run.points)
    assert run.config == SETTINGS
