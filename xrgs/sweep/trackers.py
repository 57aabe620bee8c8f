"""Where people follow trainings: TensorBoard, Weights & Biases, MLflow, or tables.

A sink takes the curves of one cell, step by step. Its `sent` is the last step that has arrived; a
new sink reads it back from the tracker. So a cell that resumes, in this sweep or a later one,
continues its run, and no step is there twice.
"""

from __future__ import annotations

import csv
import io
import os
import time
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from xrgs.errors import StoreError
from xrgs.evaluation.metrics import METRICS
from xrgs.safeio.atomic import write_json, write_text
from xrgs.safeio.records import read_struct, read_table
from xrgs.safeio.sanitize import for_csv, for_file_name, for_line

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping
    from pathlib import Path

#: The values of each step by the names of their series: `history/<column>`, `quality/<score>`
#: (during training) and `score/<metric>` (at the end).
Curves = dict[int, dict[str, float]]
#: The names of a cell in the record of a sweep.
NAMES = ("scene", "label", "condition", "variant_seed", "seed")
#: The most parameters that MLflow takes at once.
_MAX_PARAMS = 100
#: The project of Weights & Biases and the experiment of MLflow.
_PROJECT = "xrgs"
#: Seconds after which the process of Weights & Biases writes values to disk.
_WANDB_S = 0.2
#: The variable that names MLflow's server.
_SERVER = "MLFLOW_TRACKING_URI"


@dataclass(frozen=True)
class Run:
    """One cell, as trackers name it."""

    cell_id: str
    names: Mapping[str, str | int]
    """Scene, label, condition and seeds, as the sweep names them."""
    config: Mapping[str, str | float]
    """The values of its config by dotted keys."""
    steps: int

    @property
    def name(self) -> str:
        """The cell's name for people, and for a folder; unique to the cell."""
        words = (str(self.names[key]) for key in ("scene", "label", "condition"))
        seeds = f"seed-{self.names['variant_seed']}-{self.names['seed']}"
        return "--".join(map(for_file_name, filter(None, (*words, seeds, self.cell_id))))


class Sink:
    """Takes the curves of one cell. Any method may raise an error of a package, server or disk."""

    sent = -1
    """The last step that is there; -1 where none is."""

    def send(self, new: Curves) -> None:
        """Add steps, all later than `sent`; people see them at once."""
        raise NotImplementedError

    def close(self, state: str) -> None:
        """End the run: the cell is `done`, `failed`, or was `stopped` and may go on later."""


class _Table(Sink):
    """One CSV file a cell, with one row for each value. It is replaced whole each time."""

    def __init__(self, run: Run, folder: Path) -> None:
        self._file = folder / f"{run.name}.csv"
        self._cell = [run.cell_id, *(for_csv(run.names[key]) for key in NAMES)]
        self._rows: list[list[object]] = []
        if self._file.exists():
            self._rows.extend([*row] for row in read_table(self._file)[1])
        self.sent = max((int(str(row[-2])) for row in self._rows), default=-1)

    def send(self, new: Curves) -> None:
        self._rows += [
            [*self._cell, for_csv(name), step, value]
            for step, values in new.items()
            for name, value in values.items()
        ]
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow(["cell_id", *NAMES, "series", "step", "value"])
        writer.writerows(self._rows)
        write_text(self._file, text.getvalue(), durable=False)


class _Events(Sink):
    """One folder of TensorBoard's events a cell; a new file in it each time it is opened.

    Each step is one record, so that a step is there whole or not at all.
    """

    def __init__(self, run: Run, folder: Path) -> None:
        from tensorboard.backend.event_processing.event_file_loader import EventFileLoader

        home = folder / run.name
        home.mkdir(exist_ok=True)
        files = sorted(home.iterdir())
        events = (event for file in files for event in EventFileLoader(str(file)).Load())
        # Tags that begin with "_" are those of the page HParams.
        steps = (e.step for e in events for value in e.summary.value if value.tag[:1] != "_")
        self.sent = max(steps, default=-1)
        # TensorBoard reads the files of a folder in the order of their names.
        self._file = home / f"events.out.tfevents.{time.time():.6f}.xrgs"
        self._records = io.BytesIO()
        self._add(file_version="brain.Event:2")
        if not files:
            self._add_config(run)

    def _add_config(self, run: Run) -> None:
        """Add the config and the names of the metrics, for the page HParams."""
        from tensorboard.plugins.hparams import summary_v2

        config = {**run.config, **run.names}
        metrics = [summary_v2.Metric(f"score/{metric.name}") for metric in METRICS]
        parameters = [summary_v2.HParam(name) for name in config]
        self._add(summary=summary_v2.hparams_config_pb(parameters, metrics))
        self._add(summary=summary_v2.hparams_pb(config, trial_id=run.cell_id))

    def _add(self, **event: Any) -> None:
        from tensorboard.compat.proto.event_pb2 import Event
        from tensorboard.summary.writer.record_writer import RecordWriter

        content = Event(wall_time=time.time(), **event).SerializeToString()
        RecordWriter(self._records).write(content)

    def send(self, new: Curves) -> None:
        from tensorboard.compat.proto.summary_pb2 import Summary

        for step, values in new.items():
            shown = [Summary.Value(tag=name, simple_value=value) for name, value in values.items()]
            self._add(step=step, summary=Summary(value=shown))
        with self._file.open("ab") as stream:
            stream.write(self._records.getvalue())
        self._records = io.BytesIO()


class _MLflow(Sink):
    """A run on the server that the environment names, or in the store's own SQLite file."""

    def __init__(self, run: Run, folder: Path) -> None:
        from mlflow import MlflowClient

        self._client = client = MlflowClient(mlflow_uri(folder))
        stored = client.get_experiment_by_name(_PROJECT)
        experiment = stored.experiment_id if stored else client.create_experiment(_PROJECT)
        runs = client.search_runs([experiment], f"tags.cell_id = '{run.cell_id}'", max_results=1)
        if not runs:
            self._id, self._ended, self.sent = self._create(experiment, run), False, -1
            return
        self._id, self._ended = runs[0].info.run_id, runs[0].info.status == "FINISHED"
        if self._ended:
            self.sent = run.steps
            return
        histories = [client.get_metric_history(self._id, name) for name in runs[0].data.metrics]
        self.sent = max((metric.step for history in histories for metric in history), default=-1)
        client.update_run(self._id, status="RUNNING")

    def _create(self, experiment: str, run: Run) -> str:
        from mlflow.entities import Param

        tags = {key: for_line(str(value)) for key, value in run.names.items()}
        tags["cell_id"] = run.cell_id
        run_id = str(self._client.create_run(experiment, tags=tags, run_name=run.name).info.run_id)
        params = [Param(key, str(value)) for key, value in run.config.items()]
        for at in range(0, len(params), _MAX_PARAMS):
            self._client.log_batch(run_id, params=params[at : at + _MAX_PARAMS])
        return run_id

    def send(self, new: Curves) -> None:
        from mlflow.entities import Metric

        now = int(time.time() * 1000)
        for step, values in new.items():
            metrics = [Metric(name, value, now, step) for name, value in values.items()]
            self._client.log_batch(self._id, metrics=metrics)

    def close(self, state: str) -> None:
        status = {"done": "FINISHED", "failed": "FAILED"}.get(state, "KILLED")
        if not self._ended:
            self._client.set_terminated(self._id, status)


class _Wandb(Sink):
    """A run of Weights & Biases, whose id is the cell's.

    The package can't read its own files back, so a file beside them keeps the last step.
    """

    def __init__(self, run: Run, folder: Path) -> None:
        self._run, self._folder = run, folder
        self._opened: Any = None
        self._mark = folder / f"{run.cell_id}.json"
        with suppress(StoreError):  # there is none yet
            self.sent = read_struct(self._mark, int)

    def _open(self) -> Any:
        import wandb

        settings = wandb.Settings(
            console="off",
            disable_code=True,
            disable_git=True,
            silent=True,
            x_disable_stats=True,
            x_transaction_log_flush_interval=_WANDB_S,
        )
        offline = wandb.setup(settings).settings.mode != "online"
        # Without a key `init` would ask for one on the terminal of the sweep.
        if not offline and not wandb.login(prompt=False):
            raise RuntimeError("no key is set: call `wandb login`, or set WANDB_MODE=offline")
        return wandb.init(
            project=os.environ.get("WANDB_PROJECT", _PROJECT),
            id=self._run.cell_id,
            name=self._run.name,
            config={**self._run.config, **self._run.names},
            dir=self._folder.parent,  # it adds a folder `wandb`
            resume="allow",
            reinit="create_new",  # several cells may train at once
            settings=settings,
        )

    def send(self, new: Curves) -> None:
        self._opened = self._opened or self._open()
        for step, values in new.items():
            self._opened.log(values, step=step, commit=True)
        # A kill loses values that W&B's own process has not written yet, and it reports no write.
        time.sleep(2 * _WANDB_S)
        write_json(self._mark, max(new), durable=False)

    def close(self, state: str) -> None:
        if self._opened is not None:
            self._opened.finish(exit_code=0 if state == "done" else 1)


def mlflow_uri(folder: Path) -> str:
    """Return the address of MLflow's server, or of the file in its folder of the store."""
    return os.environ.get(_SERVER) or f"sqlite:///{(folder / 'mlflow.db').absolute()}"


#: The sinks by the values of `track`. Each gets a cell and the folder of its kind in the store.
SINKS: dict[str, Callable[[Run, Path], Sink]] = {
    "csv": _Table,
    "tensorboard": _Events,
    "mlflow": _MLflow,
    "wandb": _Wandb,
}
