"""What is tracked, against the readers of TensorBoard, MLflow and Python's csv."""

from __future__ import annotations

import csv
import json
import math
from typing import Any

import pytest
from mlflow import MlflowClient
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from xrgs.errors import XrgsError
from xrgs.experiment.cell_folder import CellFolder
from xrgs.experiment.results import cell_columns
from xrgs.experiment.store import Store
from xrgs.sweep import track

SUMMARY = {
    "training_time_s": 1.5,
    "render_time_ms": 2.0,
    "gaussians": 7,
    "memory_bytes": 1000,
    "evaluations": 500,
}
HISTORY = "step,view,loss,mip.sigma\n0,a,0.5,\n10,b,0.25,0.125\n"
QUALITY = "step,seconds,psnr\n10,1.5,18.5\n"
EXPECTED = {
    "history/loss": [(0, 0.5), (10, 0.25)],
    "history/mip.sigma": [(10, 0.125)],
    "quality/seconds": [(10, 1.5)],
    "quality/psnr": [(10, 18.5)],
    **{
        f"score/{name}": [(20, float(SUMMARY[name]))]
        for name in (
            "gaussians",
            "training_time_s",
            "render_time_ms",
            "memory_bytes",
            "evaluations",
        )
    },
    "score/psnr": [(20, 25.25)],
}


def add(cells: Any, name: str, *, quality: bool = True) -> CellFolder:
    cell: CellFolder = cells.begin(name, seed=3)
    (cell.path / "history.csv").write_text(HISTORY)
    if quality:
        (cell.path / "quality.csv").write_text(QUALITY)
    cells.finish(cell)
    (cell.path / "scores.csv").write_text("view,psnr,lpips\na,20.5,\nb,30.0,\n")
    cell.finish(["a", "b"], {})
    return cell


@pytest.fixture
def swept(cells: Any) -> tuple[Store, str]:
    """A store, and a sweep of two finished cells, a failed one and one that was never planned."""
    add(cells, "abc")
    add(cells, "def", quality=False)
    cells.begin("bad").fail("out of memory")
    labels = {"abc": "baseline", "def": "=cmd|'x'\x1b", "bad": "baseline", None: "baseline"}
    rows = [(name, "fern", label) for name, label in labels.items()]
    return cells.store, cells.record(*rows, seed=3)


def settings(store: Store) -> dict[str, Any]:
    """What is tracked of a config: the groups that can change a number, lists and None as texts."""
    columns = cell_columns(store.cell("abc"), None)
    values = {key: value for key, value in columns.items() if "." in key}
    return {k: v if isinstance(v, (str, float, int)) else str(v) for k, v in values.items()}


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


@pytest.mark.slow
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
    assert run.data.params == {key: str(value) for key, value in settings(store).items()}
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
    assert "abc: it is not tracked: " in capsys.readouterr().err
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
    run = track.run_of(store.cell("abc"), store.sweep_record().cells[0])
    assert not any(math.isnan(point.value) for point in run.points)
    assert run.config == settings(store)
    assert run.config["train.steps"] == store.cell("abc").config().train.steps
