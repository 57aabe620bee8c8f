"""Writes the curves of a sweep's cells to TensorBoard, Weights & Biases, MLflow, or tables.

A cell writes `history.csv` and `quality.csv` as it trains, wherever its launcher runs it. A thread
of the sweep reads these files as they grow. So tracking takes no time and no memory from a
training, and no cell can fail by it.

A sink takes the curves of one cell, step by step. Its `sent` is the last step that has arrived; a
new sink reads it back from the tracker. So a cell that resumes, in this sweep or a later one,
continues its run, and no step is there twice.
"""

from __future__ import annotations

import io
import math
import os
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Self

from xrgs.errors import StoreError, UnreadableError, XrgsError
from xrgs.evaluation.metrics import METRICS
from xrgs.photos import scenes
from xrgs.runtime.progress import log_line
from xrgs.safeio.atomic import write_json, write_text
from xrgs.safeio.records import read_struct, read_table, table_text
from xrgs.safeio.sanitize import for_csv, for_file_name, for_line
from xrgs.store.cell_folder import HISTORY, STATUS, CellFolder, number_columns
from xrgs.store.listing import modified
from xrgs.store.store import Store
from xrgs.sweep.plan import PlannedCell

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
        self._cell = {"cell_id": run.cell_id, **{key: for_csv(run.names[key]) for key in NAMES}}
        self._rows: list[dict[str, Any]] = []
        if self._file.exists():
            header, rows = read_table(self._file)
            self._rows += [dict(zip(header, row, strict=True)) for row in rows]
        self.sent = max((int(row["step"]) for row in self._rows), default=-1)

    def send(self, new: Curves) -> None:
        self._rows += [
            {**self._cell, "series": for_csv(name), "step": step, "value": value}
            for step, values in new.items()
            for name, value in values.items()
        ]
        write_text(self._file, table_text(self._rows), durable=False)


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
    return os.environ.get("MLFLOW_TRACKING_URI") or f"sqlite:///{(folder / 'mlflow.db').absolute()}"


#: The sinks by the values of `track`. Each gets a cell and the folder of its kind in the store.
SINKS: dict[str, Callable[[Run, Path], Sink]] = {
    "csv": _Table,
    "tensorboard": _Events,
    "mlflow": _MLflow,
    "wandb": _Wandb,
}


#: The folder of a store for tracking; each kind has a folder in it.
FOLDER = "tracking"
#: The values of `track`. A kind but the first two needs the package and the extra of its name.
KINDS = ("none", *SINKS)
#: Seconds between two looks at the cells, and from a failure to the next look.
_POLL_S, _PAUSE_S = 2.0, 30.0
#: Seconds that the end of a sweep waits for a tracker, for example for a server that is away.
_END_S = 60.0


def check(kind: str) -> None:
    """Check, before anything is trained, that cells can be tracked with this value of `track`."""
    if kind not in KINDS:
        raise XrgsError(f"track={kind}: must be one of {', '.join(KINDS)}")
    if kind not in KINDS[:2] and find_spec(kind) is None:
        raise XrgsError(f"track={kind}: it is not installed: pip install 'xrgs[{kind}]'")


def curves(cell: CellFolder, *, done: bool) -> Curves:
    """Read the curves that a cell has written so far.

    Unless the cell is done, they end with the last row of the history: scores of later steps may
    not be complete.

    Raises:
        StoreError: A file can't be read; the message names it.
        ValueError: A value is not a number.
    """
    history = _table(cell.path / HISTORY, "history")
    rows = [*history]
    if (quality := cell.path / "quality.csv").is_file():
        rows += _table(quality, "quality")
    if done:
        from xrgs.store.results import cell_metrics  # pandas is slow to load

        summary = cell.summary()
        scores = cell_metrics(summary, cell.scores())
        rows.append((summary.steps, {f"score/{name}": score for name, score in scores.items()}))
    else:
        rows = [(step, values) for step, values in rows if step <= history[-1][0]]
    by_step: Curves = {}
    for step, values in sorted(rows, key=lambda row: row[0]):
        numbers = {name: value for name, value in values.items() if not math.isnan(value)}
        by_step.setdefault(step, {}).update(numbers)
    return by_step


def _table(file: Path, group: str) -> list[tuple[int, dict[str, float]]]:
    """Return the step and the numbers of each row of a table."""
    columns = number_columns(file)
    steps = map(int, columns.pop("step"))
    names = [f"{group}/{name}" for name in columns]
    rows = zip(*columns.values(), strict=True)
    return [
        (step, dict(zip(names, row, strict=True))) for step, row in zip(steps, rows, strict=True)
    ]


def run_of(planned: PlannedCell, cell: CellFolder) -> Run:
    """Return how trackers name a planned cell, whose folder has its config."""
    from xrgs.store.results import cell_columns  # pandas is slow to load

    conf, spec = planned.conf, planned.spec
    config = {key: value for key, value in cell_columns(cell, None).items() if "." in key}
    return Run(
        cell.id,
        {
            "scene": scenes.label(conf.scene),
            "label": spec.label,
            "condition": spec.condition,
            "variant_seed": conf.variant.seed,
            "seed": conf.seed,
        },
        {k: v if isinstance(v, (str, float, int)) else str(v) for k, v in config.items()},
        conf.train.steps,
    )


class _Followed:
    """A cell whose curves are sent to a tracker, and which of its files were sent."""

    def __init__(self, planned: PlannedCell, cell: CellFolder) -> None:
        self.cell = cell
        self._planned = planned
        self._sink: Sink | None = None
        self._seen: tuple[float, ...] = ()
        """The times of the files that were sent last."""
        self.ended = False
        """Whether nothing more is to be sent: the cell is done, or can't be read."""

    def send(self, kind: str, folder: Path) -> None:
        """Send the steps that the tracker lacks.

        Raises:
            Exception: Whatever a package, a server or a disk raises. The next call asks the
                tracker for its last step, and goes on from there.
        """
        names = () if self.ended else (HISTORY, STATUS)
        written = tuple(when for name in names if (when := modified(self.cell.path / name)))
        if not written or written == self._seen:
            return
        state = self.cell.state(verify=False).name
        try:
            by_step = curves(self.cell, done=state == "done")
        except (StoreError, ValueError) as error:
            # Read again, if a new attempt is replacing the file or it can't be read now.
            self.ended = state == "done" and not isinstance(error, UnreadableError)
            if self.ended:
                log_line(f"{self.cell.id}: it is not tracked: {error}")
            return
        try:
            if self._sink is None:
                self._sink = SINKS[kind](run_of(self._planned, self.cell), folder)
            if new := {step: by_step[step] for step in by_step if step > self._sink.sent}:
                self._sink.send(new)
                self._sink.sent = max(new)
            if state in {"done", "failed"}:
                self.close(state)
        except BaseException:
            self._sink = None  # the next one reads its last step anew
            raise
        self._seen, self.ended = written, state == "done"

    def close(self, state: str) -> None:
        """End the run of a cell that is `done`, `failed` or `stopped`."""
        if self._sink is not None:
            self._sink.close(state)
            self._sink = None


class Tracker:
    """Follows the cells of a sweep in a thread while a `with` block runs."""

    def __init__(self, kind: str, store: Store) -> None:
        """Prepare to follow cells of a store; `kind` is a value of `track`."""
        self._kind = kind
        self._store = store
        self._folder = store.path / FOLDER / kind
        self._cells: dict[str, _Followed] = {}
        self._elsewhere: set[str | None] = set()
        """Cells that another sweep trains, and follows."""
        self._failed = self._has_said_so = False
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._follow, name="xrgs-track", daemon=True)

    def watch(self, plan: Sequence[PlannedCell]) -> None:
        """Set the cells to follow; called again when they change."""
        for cell in plan:
            if cell.state.name == "running":
                self._elsewhere.add(cell.cell_id)
            elif cell.state.name != "done":  # its other sweep has left it
                self._elsewhere.discard(cell.cell_id)
        ours = {cell.cell_id: cell for cell in plan if cell.cell_id not in self._elsewhere}
        # A new dict, because the thread goes over the old one.
        self._cells = {
            name: self._cells.get(name) or _Followed(cell, self._store.cell(name))
            for name, cell in ours.items()
            if name is not None
        }

    def __enter__(self) -> Self:
        if self._kind != "none":
            log_line(f"track={self._kind}: {self._hint()}")
            self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        if self._kind == "none":
            return
        self._thread.join(_END_S)
        late = self._thread.is_alive()
        if late or self._failed:
            why = f"no answer for {_END_S:.0f} s" if late else "it failed"
            log_line(
                f"track={self._kind}: {why}, and the curves there are not complete; the cells are"
                " in the store, and the same command sends the rest"
            )

    def _hint(self) -> str:
        """Return where people find the curves: a command, an address or a folder."""
        if self._kind == "tensorboard":
            return f"tensorboard --logdir {self._folder}"
        if self._kind == "mlflow":
            uri = mlflow_uri(self._folder)
            return f"mlflow ui --backend-store-uri {uri}" if uri.startswith("sqlite:") else uri
        if self._kind == "wandb":
            return f"with WANDB_MODE=offline, `wandb sync {self._folder}/offline-run-*` sends it"
        return str(self._folder)

    def _follow(self) -> None:
        while not self._stop.wait(_PAUSE_S if self._failed else _POLL_S):
            self.look()
        self.look()
        self.close()

    def look(self) -> None:
        """Send the new steps of each cell; print a message the first time that this fails."""
        self._failed = False
        for cell in self._cells.values():
            try:
                self._folder.mkdir(parents=True, exist_ok=True)
                cell.send(self._kind, self._folder)
            except Exception as error:  # of a package, a server or a disk
                self._failed = True
                if not self._has_said_so:
                    log_line(
                        f"track={self._kind}: {type(error).__name__}: {error}; the cells train on,"
                        f" and it is tried again every {_PAUSE_S:.0f} s"
                    )
                self._has_said_so = True

    def close(self) -> None:
        """End the runs that are still open: their cells were stopped."""
        for cell in self._cells.values():
            with suppress(Exception):  # the steps that were sent are there
                cell.close("stopped")
