"""Writes the cells of a sweep to where people follow experiments: TensorBoard, MLflow or a table.

Cells are read from the store when the sweep has ended, so that tracking takes no time or memory
from a training. A failure is a warning, because the cells are in the store.
"""

from __future__ import annotations

import csv
import io
import math
import os
from dataclasses import dataclass
from importlib.util import find_spec
from typing import TYPE_CHECKING, NamedTuple

from xrgs.errors import StoreError, XrgsError
from xrgs.runtime.progress import log_line, progress
from xrgs.safeio.atomic import atomic_writer
from xrgs.safeio.files import remove_path
from xrgs.safeio.records import as_number, read_table
from xrgs.safeio.sanitize import for_csv, for_file_name, for_line

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping
    from pathlib import Path

    from xrgs.experiment.cell_folder import CellFolder
    from xrgs.experiment.schema import RecordedCell
    from xrgs.experiment.store import Store

#: The folder of a store for tracking.
FOLDER = "tracking"
#: The package that a kind needs; the extra has the kind's name.
_PACKAGES = {"tensorboard": "tensorboard", "mlflow": "mlflow"}
#: The names of a cell in the record of a sweep.
_NAMES = ("scene", "label", "condition", "variant_seed", "seed")
#: The most metrics and parameters that MLflow takes at once.
_MAX_METRICS, _MAX_PARAMS = 1000, 100
#: The variable that names MLflow's server, and the name of the experiment there.
_SERVER, _EXPERIMENT = "MLFLOW_TRACKING_URI", "xrgs"


class Point(NamedTuple):
    """One value of a series."""

    series: str
    """`history/<column>`, `quality/<score>` (during training) or `score/<metric>` (of the end)."""
    step: int
    value: float


@dataclass(frozen=True)
class Run:
    """The tracked values of one finished cell."""

    cell_id: str
    names: Mapping[str, str | int]
    """Scene, label, condition and seeds, as the sweep names them."""
    config: Mapping[str, str | float]
    """The values of its config by dotted keys."""
    points: tuple[Point, ...]
    """Its history, its quality during training and its scores; no NaN."""

    @property
    def name(self) -> str:
        """The cell's name for people, and for a folder; unique to the cell."""
        words = (str(self.names[key]) for key in ("scene", "label", "condition"))
        seeds = f"seed-{self.names['variant_seed']}-{self.names['seed']}"
        return "--".join(map(for_file_name, filter(None, (*words, seeds, self.cell_id))))


def check(kind: str) -> None:
    """Check, before anything is trained, that cells can be tracked with this value of `track`.

    Raises:
        XrgsError: There is no such kind, or its package is not installed.
    """
    if kind not in KINDS:
        raise XrgsError(f"track={kind}: must be one of {', '.join(KINDS)}")
    if kind in _PACKAGES and find_spec(_PACKAGES[kind]) is None:
        raise XrgsError(f"track={kind}: it is not installed: pip install 'xrgs[{kind}]'")


def track(kind: str, store: Store, sweep_id: str) -> None:
    """Write the finished cells of a sweep, and say where; a failure is a warning."""
    if kind == "none":
        return
    folder = store.path / FOLDER
    try:
        folder.mkdir(exist_ok=True)
        where = _WRITERS[kind](_runs(store, sweep_id), folder, sweep_id)
    except Exception as error:  # of a package, a server or a disk: no cell may fail by it
        log_line(f"track={kind}: {type(error).__name__}: {error}; the cells are in the store")
    else:
        log_line(f"track={kind}: {where}")


def run_of(cell: CellFolder, names: RecordedCell) -> Run:
    """Read the tracked values of a finished cell, which the record of a sweep names.

    Raises:
        StoreError: A file can't be read; the message names it.
        ValueError: A value is not a number.
    """
    from xrgs.experiment.results import cell_columns, cell_metrics  # pandas is slow to load

    points = _points(cell.path / "history.csv", "history")
    if (cell.path / "quality.csv").is_file():
        points += _points(cell.path / "quality.csv", "quality")
    summary = cell.summary()
    steps = summary.steps
    scores = cell_metrics(summary, cell.scores())
    points += [Point(f"score/{name}", steps, value) for name, value in scores.items()]
    config = {key: value for key, value in cell_columns(cell, None).items() if "." in key}
    return Run(
        cell.id,
        {key: getattr(names, key) for key in _NAMES},
        {k: v if isinstance(v, (str, float, int)) else str(v) for k, v in config.items()},
        tuple(point for point in points if not math.isnan(point.value)),
    )


def _points(file: Path, group: str) -> list[Point]:
    """Return the numbers of a table with a column `step`."""
    header, rows = read_table(file)
    table = [dict(zip(header, row, strict=True)) for row in rows]
    return [
        Point(f"{group}/{name}", int(row["step"]), as_number(value))
        for row in table
        for name, value in row.items()
        if name not in {"step", "view"}
    ]


def _runs(store: Store, sweep_id: str) -> Iterator[Run]:
    """Yield the finished cells of a sweep; name each cell that can't be read on stderr."""
    rows = {row.cell_id: row for row in store.sweep_record(sweep_id).cells}
    for cell_id, row in progress(rows.items(), "tracking", "cell", len(rows)):
        if cell_id is None or store.cell(cell_id).state(verify=False).name != "done":
            continue
        try:
            yield run_of(store.cell(cell_id), row)
        except (StoreError, OSError, ValueError) as error:
            log_line(f"{cell_id}: it is not tracked: {error}")


def _to_csv(runs: Iterable[Run], folder: Path, sweep_id: str) -> str:
    """Write one row for each value of each cell."""
    file = folder / f"{sweep_id}.csv"
    with atomic_writer(file) as stream:
        text = io.TextIOWrapper(stream, encoding="utf-8", newline="", write_through=True)
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow(["cell_id", *_NAMES, *Point._fields])
        for run in runs:
            names = [for_csv(run.names[key]) for key in _NAMES]
            writer.writerows([run.cell_id, *names, *map(for_csv, point)] for point in run.points)
        text.detach()
    return str(file)


def _to_tensorboard(runs: Iterable[Run], folder: Path, _: str) -> str:
    """Write a folder of events for each cell that has none."""
    home = folder / "tensorboard"
    home.mkdir(exist_ok=True)
    for run in runs:
        done, new = home / run.name, home / f".{run.name}.new"
        if done.exists():
            continue
        remove_path(new)
        new.mkdir(exist_ok=True)
        _write_events(run, str(new))
        new.rename(done)
    return f"tensorboard --logdir {home}"


def _write_events(run: Run, folder: str) -> None:
    from tensorboard.compat.proto.event_pb2 import Event
    from tensorboard.compat.proto.summary_pb2 import Summary
    from tensorboard.plugins.hparams import summary_v2
    from tensorboard.summary.writer.event_file_writer import EventFileWriter

    names = sorted({point.series for point in run.points if point.series.startswith("score/")})
    config = {**run.config, **run.names}
    writer = EventFileWriter(folder)
    metrics = [summary_v2.Metric(name) for name in names]
    parameters = [summary_v2.HParam(name) for name in config]
    for summary in (
        summary_v2.hparams_config_pb(parameters, metrics),
        summary_v2.hparams_pb(config, trial_id=run.cell_id),
    ):
        writer.add_event(Event(summary=summary))
    for point in run.points:
        value = Summary.Value(tag=point.series, simple_value=point.value)
        writer.add_event(Event(step=point.step, summary=Summary(value=[value])))
    writer.close()


def _to_mlflow(runs: Iterable[Run], folder: Path, sweep_id: str) -> str:
    """Log a run for each cell that has none, on the environment's server or in the store."""
    from mlflow import MlflowClient
    from mlflow.entities import Metric, Param

    file = folder / "mlflow.db"
    uri = os.environ.get(_SERVER) or f"sqlite:///{file.absolute()}"
    client = MlflowClient(uri)
    found = client.get_experiment_by_name(_EXPERIMENT)
    experiment = found.experiment_id if found else client.create_experiment(_EXPERIMENT)
    for run in runs:
        tag = f"tags.cell_id = '{run.cell_id}' and attributes.status = 'FINISHED'"
        if client.search_runs([experiment], tag, max_results=1):
            continue
        tags = {key: for_line(str(value)) for key, value in run.names.items()}
        tags |= {"cell_id": run.cell_id, "sweep": sweep_id}
        run_id = client.create_run(experiment, tags=tags, run_name=run.name).info.run_id
        parameters = [Param(key, str(value)) for key, value in run.config.items()]
        for at in range(0, len(parameters), _MAX_PARAMS):
            client.log_batch(run_id, params=parameters[at : at + _MAX_PARAMS])
        metrics = [Metric(p.series, p.value, 0, p.step) for p in run.points]
        for at in range(0, len(metrics), _MAX_METRICS):
            client.log_batch(run_id, metrics=metrics[at : at + _MAX_METRICS])
        client.set_terminated(run_id)
    return f"mlflow ui --backend-store-uri {uri}"


_WRITERS = {"csv": _to_csv, "tensorboard": _to_tensorboard, "mlflow": _to_mlflow}
KINDS = ("none", *_WRITERS)
"""The values of `track`."""
