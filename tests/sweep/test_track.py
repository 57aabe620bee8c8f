"""Curves of cells that train, against the readers of TensorBoard, W&B, MLflow and Python's csv."""

from __future__ import annotations

import csv
import os
import struct
import sys
import threading
from collections import defaultdict
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from xrgs.errors import XrgsError
from xrgs.store.cell_folder import CellFolder, CellState
from xrgs.store.results import cell_columns
from xrgs.sweep import track
from xrgs.sweep.axes import CellSpec
from xrgs.sweep.plan import PlannedCell

#: The values of each series by their steps.
Series = dict[str, list[tuple[int, float]]]

HISTORY = ["step,view,loss,mip.sigma", "0,a,0.5,", "10,b,0.25,0.125", "19,a,0.125,0.5"]
QUALITY = ["step,seconds,psnr", "5,0.75,16.5", "15,1.5,18.5"]
EXPECTED: Series = {
    "history/loss": [(0, 0.5), (10, 0.25), (19, 0.125)],
    "history/mip.sigma": [(10, 0.125), (19, 0.5)],
    "quality/seconds": [(5, 0.75), (15, 1.5)],
    "quality/psnr": [(5, 16.5), (15, 18.5)],
    "score/gaussians": [(20, 7.0)],
    "score/training_time_s": [(20, 1.5)],
    "score/render_time_ms": [(20, 2.0)],
    "score/memory_bytes": [(20, 1000.0)],
    "score/evaluations": [(20, 500.0)],
    "score/psnr": [(20, 25.25)],
}


class Swept:
    """Cells that train, and the trackers that follow them."""

    def __init__(self, cells: Any) -> None:
        self.cells, self.store = cells, cells.store
        self.cells.conf.train.steps = 20

    def planned(self, name: str, state: str = "absent", label: str = "baseline") -> PlannedCell:
        conf = self.cells.conf
        return PlannedCell(CellSpec(label, "", (), ()), conf, "v", None, name, CellState(state))

    def begin(self, name: str) -> CellFolder:
        cell: CellFolder = self.cells.begin(name)
        return cell

    def train(self, cell: CellFolder, rows: int, evaluations: int = 0) -> None:
        """Write the first rows of the history and of the quality, as a training cell does."""
        if evaluations:
            (cell.path / "quality.csv").write_text("\n".join(QUALITY[: evaluations + 1]) + "\n")
        (cell.path / "history.csv").write_text("\n".join(HISTORY[: rows + 1]) + "\n")

    def finish(self, cell: CellFolder) -> None:
        self.train(cell, 3, 2)
        self.cells.finish(cell)
        (cell.path / "scores.csv").write_text("view,psnr,lpips\na,20.5,\nb,30.0,\n")
        cell.finish(["a", "b"], {})

    def tracker(self, kind: str, *plan: PlannedCell) -> track.Tracker:
        tracker = track.Tracker(kind, self.store)
        tracker.watch(plan)
        return tracker


@pytest.fixture
def swept(cells: Any, monkeypatch: pytest.MonkeyPatch) -> Swept:
    """An empty store, and no tracker's server in the environment."""
    # W&B goes on without its launcher, whose import takes seconds.
    monkeypatch.setitem(sys.modules, "wandb.sdk.launch.inputs.internal", None)
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
    monkeypatch.setenv("WANDB_MODE", "offline")
    return Swept(cells)


def in_tables(folder: Path, cell_id: str) -> Series:
    (file,) = folder.glob(f"*--{cell_id}.csv")
    found: Series = defaultdict(list)
    for row in csv.DictReader(file.read_text().splitlines()):
        found[row["series"]].append((int(row["step"]), float(row["value"])))
    return found


# The readers are imported where they are used: each takes a second or more in every worker.


def in_tensorboard(folder: Path, cell_id: str) -> Series:
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    (run,) = folder.glob(f"*--{cell_id}")
    events = EventAccumulator(str(run)).Reload()
    plugin = events.summary_metadata["_hparams_/session_start_info"].plugin_data.content
    assert b"train.steps" in plugin
    return {
        name: [(event.step, event.value) for event in events.Scalars(name)]
        for name in events.Tags()["scalars"]
    }


def mlflow_runs(folder: Path) -> tuple[Any, dict[str, Any]]:
    """The client of MLflow, and the runs by the ids of their cells."""
    from mlflow import MlflowClient

    client = MlflowClient(f"sqlite:///{folder}/mlflow.db")
    (experiment,) = [e for e in client.search_experiments() if e.name == "xrgs"]
    runs = client.search_runs([experiment.experiment_id])
    found = {run.data.tags["cell_id"]: run for run in runs}
    assert len(found) == len(runs)
    return client, found


def in_mlflow(folder: Path, cell_id: str) -> Series:
    client, runs = mlflow_runs(folder)
    run = runs[cell_id]
    assert run.data.params["train.steps"] == "20"
    return {
        name: [(m.step, m.value) for m in client.get_metric_history(run.info.run_id, name)]
        for name in run.data.metrics
    }


def in_wandb(folder: Path, cell_id: str) -> Series:
    """Read W&B's own records, in the order in which `wandb sync` sends the parts of a run."""
    from wandb.proto.wandb_internal_pb2 import Record

    found: Series = defaultdict(list)
    for part in sorted(folder.glob(f"offline-run-*-{cell_id}")):
        for content in leveldb_records((part / f"run-{cell_id}.wandb").read_bytes()):
            record = Record.FromString(content)
            if record.WhichOneof("record_type") == "history":
                for item in record.history.item:
                    name = item.nested_key[0]
                    if not name.startswith("_"):
                        row = record.history.step.num, float(item.value_json)
                        found[name].append(row)
    return found


def leveldb_records(content: bytes, block: int = 1 << 15) -> Iterator[bytes]:
    """The records of a LevelDB log behind W&B's header of 7 bytes."""
    at, record = 7, b""
    while at + 7 <= len(content):
        if block - at % block < 7:
            at += block - at % block
            continue
        _, size, kind = struct.unpack_from("<IHB", content, at)
        record += content[at + 7 : at + 7 + size]
        at += 7 + size
        if kind in {1, 4}:  # whole, or the last part
            yield record
            record = b""


def check(found: Series) -> None:
    """Assert that each value of a finished cell is there once; metrics may derive more scores."""
    assert {name: found.get(name) for name in EXPECTED} == EXPECTED
    assert all(name.startswith("score/") for name in found.keys() - EXPECTED.keys())


READERS: dict[str, Callable[[Path, str], Series]] = {
    "csv": in_tables,
    "tensorboard": in_tensorboard,
    "mlflow": in_mlflow,
    "wandb": in_wandb,
}
SLOW = {"mlflow", "tensorboard", "wandb"}
EACH_KIND = pytest.mark.parametrize(
    "kind", [pytest.param(kind, marks=[pytest.mark.slow] * (kind in SLOW)) for kind in READERS]
)


@EACH_KIND
@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # MLflow's own, of SQLAlchemy 2.1
def test_a_resumed_cell_continues_its_curve(swept: Swept, kind: str) -> None:
    cell, folder = swept.begin("abc"), swept.store.path / "tracking" / kind
    planned = swept.planned("abc", label="=cmd|'x'\x1b")
    tracker = swept.tracker(kind, planned)
    tracker.look()
    assert not list(folder.iterdir()), "nothing is sent before the first row"
    swept.train(cell, 1)
    tracker.look()
    swept.train(cell, 2, 2)  # step 15 was evaluated; a history's row before it may follow
    tracker.look()
    tracker.close()
    if kind != "wandb":  # whose records a process of its own may still be writing
        live = READERS[kind](folder, "abc")
        assert live["history/loss"] == [(0, 0.5), (10, 0.25)]
        assert live["quality/psnr"] == [(5, 16.5)]
    # Another process goes on, from a checkpoint before the last row.
    tracker = swept.tracker(kind, planned)
    for rows in (1, 2):
        swept.train(cell, rows, rows)
        tracker.look()
    swept.finish(cell)
    tracker.look()
    tracker.close()
    swept.tracker(kind, planned).look()  # of a later sweep, which finds it complete
    check(READERS[kind](folder, "abc"))
    if kind == "mlflow":  # how a cell ended is shown too
        for name in ("failed", "stopped"):
            swept.train(swept.begin(name), 1)
        tracker = swept.tracker(kind, *map(swept.planned, ("failed", "stopped")))
        tracker.look()
        assert states(folder) == {"abc": "FINISHED", "failed": "RUNNING", "stopped": "RUNNING"}
        swept.store.cell("failed").fail("out of memory")
        tracker.look()
        tracker.close()
        assert states(folder) == {"abc": "FINISHED", "failed": "FAILED", "stopped": "KILLED"}


def states(folder: Path) -> dict[str, str]:
    return {name: run.info.status for name, run in mlflow_runs(folder)[1].items()}


def test_a_table_and_a_run_have_the_names_and_settings_of_their_cell(swept: Swept) -> None:
    swept.finish(swept.begin("abc"))
    run = track.run_of(swept.planned("abc"), swept.store.cell("abc"))
    columns = cell_columns(swept.store.cell("abc"), None)
    values = {key: value for key, value in columns.items() if "." in key}
    texts = {k: v if isinstance(v, (str, float, int)) else str(v) for k, v in values.items()}
    assert run.config == texts
    assert run.config["train.steps"] == run.steps == 20
    assert run.name == "motorcycle--baseline--seed-0-0--abc"
    swept.tracker("csv", swept.planned("abc", label="=cmd|'x'\x1b")).look()
    (file,) = (swept.store.path / "tracking" / "csv").iterdir()
    rows = list(csv.DictReader(file.read_text().splitlines()))
    assert rows[0].keys() == {"cell_id", *track.NAMES, "series", "step", "value"}
    assert {row["label"] for row in rows} == {"'=cmd|'x'"}, "no formula, no escape"
    assert {row["cell_id"] for row in rows} == {"abc"}


def test_a_record_that_a_kill_cut_off_is_written_again(swept: Swept) -> None:
    cell, folder = swept.begin("abc"), swept.store.path / "tracking" / "tensorboard"
    swept.train(cell, 2)
    swept.tracker("tensorboard", swept.planned("abc")).look()
    (file,) = folder.glob("*/*")
    os.truncate(file, file.stat().st_size - 5)
    swept.finish(cell)
    swept.tracker("tensorboard", swept.planned("abc")).look()
    check(in_tensorboard(folder, "abc"))


class Broken(track.Sink):
    """A tracker that is away for a while."""

    away = True

    def __init__(self, run: track.Run, folder: Path) -> None:
        self.check()

    def check(self) -> None:
        if self.away:
            raise ConnectionError("no server\x1b[31m")

    def send(self, new: track.Curves) -> None:
        self.check()

    def close(self, state: str) -> None:
        self.check()


@pytest.mark.parametrize("again", [False, True])
def test_a_failure_is_said_once(
    swept: Swept, again: bool, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(track.SINKS, "csv", Broken)
    monkeypatch.setattr(Broken, "away", True)
    for name in ("abc", "def"):
        swept.finish(swept.begin(name))
    with swept.tracker("csv", *map(swept.planned, ("abc", "def"))) as tracker:
        tracker.look()
        Broken.away = not again
    said = capsys.readouterr().err.splitlines()
    assert said[:2] == [
        f"track=csv: {swept.store.path}/tracking/csv",
        "track=csv: ConnectionError: no server [31m; the cells train on, and it is tried again"
        " every 30 s",
    ]
    rest = "track=csv: it failed, and the curves there are not complete; the cells are in the"
    assert [line.startswith(rest) for line in said[2:]] == [True] * (not again)


def test_an_end_does_not_wait_for_a_server_that_hangs(
    swept: Swept, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    free, sink = threading.Event(), track.SINKS["csv"]

    def hang(run: track.Run, folder: Path) -> track.Sink:
        free.wait()
        return sink(run, folder)

    monkeypatch.setattr(track, "_END_S", 0.05)
    monkeypatch.setitem(track.SINKS, "csv", hang)
    swept.finish(swept.begin("abc"))
    with swept.tracker("csv", swept.planned("abc")):
        pass
    free.set()
    assert "track=csv: no answer for 0 s, and the curves" in capsys.readouterr().err


def test_a_finished_cell_that_can_not_be_read_is_left_out(
    swept: Swept, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("abc", "def"):
        swept.finish(swept.begin(name))
    history = swept.store.cell("abc").path / "history.csv"
    text = history.read_text().replace("0.25", "1e99")  # as long, so that the cell is still done
    history.write_text(text)
    tracker = swept.tracker("csv", *map(swept.planned, ("abc", "def")))
    tracker.look()
    tracker.look()
    assert capsys.readouterr().err.count("abc: it is not tracked: ") == 1
    (file,) = (swept.store.path / "tracking" / "csv").iterdir()
    assert "--def.csv" in file.name


def test_a_cell_of_another_sweep_is_followed_there(swept: Swept) -> None:
    cell, folder = swept.begin("abc"), swept.store.path / "tracking" / "csv"
    swept.train(cell, 1)
    tracker = swept.tracker("csv", swept.planned("abc", "running"))
    swept.finish(cell)
    tracker.watch([swept.planned("abc", "done")])
    tracker.look()
    assert not folder.exists()
    tracker.watch([swept.planned("abc", "unfinished")])  # the other sweep has died
    tracker.look()
    check(in_tables(folder, "abc"))


def test_what_can_not_be_tracked_is_said_before_training(monkeypatch: pytest.MonkeyPatch) -> None:
    for kind in track.KINDS:
        track.check(kind)
    with pytest.raises(XrgsError, match="track=neptune: must be one of none, csv, tensorboard, ml"):
        track.check("neptune")
    monkeypatch.setattr(track, "find_spec", lambda _: None)
    with pytest.raises(XrgsError, match=r"track=wandb: .* pip install 'xrgs\[wandb\]'"):
        track.check("wandb")
    track.check("csv")
