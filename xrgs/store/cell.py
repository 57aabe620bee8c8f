"""Runs one cell: trains a variant with a config and a seed, scores it and writes the results."""

from __future__ import annotations

import logging
import math
import signal
import sys
import time
import traceback
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from statistics import fmean
from typing import Any, cast

import msgspec

from xrgs.config import Conf
from xrgs.evaluation import protocol
from xrgs.formats.ply import save_ply
from xrgs.mixture.views import Variant
from xrgs.runtime import progress
from xrgs.runtime.machine import peak_rss, set_torch_threads
from xrgs.runtime.progress import ProgressFile
from xrgs.runtime.signals import StopRequest, StopSignal
from xrgs.safeio.atomic import write_json, write_text
from xrgs.safeio.records import table_text
from xrgs.safeio.sanitize import for_terminal
from xrgs.splat.backend import resolve_backend
from xrgs.splat.gaussians import Gaussians
from xrgs.store import provenance
from xrgs.store.cell_folder import HISTORY, SPLATS, CellFolder
from xrgs.store.schema import Summary
from xrgs.store.scoring import scoring_code
from xrgs.training import dataset
from xrgs.training.checkpoint import Checkpoint, CheckpointError, Stateful
from xrgs.training.components import Components
from xrgs.training.count_matching import train_cell
from xrgs.training.dataset import Dataset
from xrgs.training.recorder import TrainingRecorder, TrainingResult

_log = logging.getLogger(__name__)

#: The shown loss is the mean of this many rows of the history. Each row is the loss of one view.
_SHOWN_ROWS = 10
#: Seconds between two writes of the history while a cell trains.
_CURVES_S = 5.0


class CellCheckpoint(Checkpoint):
    """Writes the checkpoint of a cell, shows its progress, and stops it on request.

    It also writes `history.csv` and `quality.csv` as the training goes on, for those who follow it.
    """

    def __init__(
        self,
        folder: CellFolder,
        every_s: float,
        shown: ProgressFile,
        stop: StopRequest,
        *,
        curves: bool = True,
    ) -> None:
        """Prepare the checkpoint of a cell; nothing is written yet.

        With `every_s` of 0 it is never written, not even when the cell is stopped. The note of
        `shown` gets the number of Gaussians, the loss and the PSNR. Without `curves` the history is
        not written during training.
        """
        super().__init__(folder.checkpoint, folder.id, every_s)
        self._folder = folder
        self._shown = shown
        self._stop = stop
        self._curves = curves
        self._rows, self._curves_due = 0, 0.0
        """Number of rows in the file of the history, and when it may be written again."""
        self._recorder: TrainingRecorder | None = None
        self._components = Components()

    def register(self, **objects: Stateful) -> None:
        """Add objects to the checkpoint by name; `recorder` and `components` are read here too."""
        super().register(**objects)
        self._recorder = cast("TrainingRecorder | None", objects.get("recorder", self._recorder))
        self._components = cast("Components", objects.get("components", self._components))

    def findings(self) -> list[str]:
        """Return the lines that components of the training have for the user."""
        return self._components.findings()

    def save_if_due(self, step: int) -> float:
        """Write the checkpoint if the interval has passed or the process is to end.

        Raises:
            StopSignal: The process was asked to end; the checkpoint is written.
        """
        if self._recorder is not None and self._recorder.history:
            self._shown.note = _note(self._recorder)
        if self._stop.received and self.every_s > 0:
            self.every_s = sys.float_info.min  # due now, whatever the interval
        seconds = super().save_if_due(step)
        if seconds:
            _log.info("%d steps done: %s", step + 1, self._shown.note)
        if self._stop.received:
            _log.info("stopped after %d steps", step + 1)
            raise StopSignal(signal.SIGTERM)
        return seconds + self._write_curves_if_due()

    def _write_curves_if_due(self) -> float:
        """Write the curves if there are new rows; return the seconds that it took."""
        start, recorder = time.monotonic(), self._recorder
        if recorder is None or not self._curves or start < self._curves_due:
            return 0.0
        if len(recorder.history) == self._rows:
            return 0.0
        with suppress(OSError):  # they are written again at the end, where an error counts
            # The scores first, so that they are there for every step that the history has.
            write_curves(self._folder, recorder.history, recorder.scores)
        self._rows, end = len(recorder.history), time.monotonic()
        self._curves_due = end + _CURVES_S
        return end - start


def _note(recorder: TrainingRecorder) -> str:
    """Return the state of a training in words, for example `84,000 Gaussians, loss 0.041`."""
    rows = recorder.history[-_SHOWN_ROWS:]
    loss = fmean(row["loss"] for row in rows)
    parts = [f"{rows[-1]['gaussians']:,} Gaussians", f"loss {loss:.3g}"]
    if recorder.scores and (psnr := recorder.scores[-1].get("psnr")) is not None:
        parts.append(f"PSNR {psnr:.2f} dB at step {recorder.scores[-1]['step']:,}")
    return ", ".join(parts)


def write_curves(
    folder: CellFolder, history: Sequence[Mapping[str, Any]], scores: Sequence[Mapping[str, Any]]
) -> None:
    """Write the record of a training: `history.csv`, and `quality.csv` if it was evaluated."""
    if scores:
        write_text(folder.path / "quality.csv", table_text(scores), durable=False)
    write_text(folder.path / HISTORY, table_text(history), durable=False)


def run_cell(
    conf: Conf, variant: Variant, folder: CellFolder, stop: StopRequest | None = None
) -> None:
    """Train and evaluate a cell, and write its results; its status is written last.

    The folder is as `begin_attempt` leaves it. When it is asked to `stop`, the cell stops after the
    current step of training. An evaluation is not stopped, since it is nearly done and would begin
    again from the last checkpoint.

    Raises:
        StopSignal: The cell was stopped; its checkpoint is written.
        Exception: Any error of the cell; its traceback is in `error.txt`.
    """
    stop = stop or StopRequest()
    try:
        with stop.deferred():
            with progress.written_to(folder.progress) as shown:
                views = _train_and_score(conf, variant, folder, shown, stop)
            folder.finish(views, scoring_code())
        _log.info("done")
    except Exception:
        write_text(folder.path / "error.txt", for_terminal(traceback.format_exc()))
        raise


def _train_and_score(
    conf: Conf, variant: Variant, folder: CellFolder, shown: ProgressFile, stop: StopRequest
) -> list[str]:
    """Write every file but the status, without a sync; return the names of the scored views."""
    threads = set_torch_threads(conf.threads)
    backend = resolve_backend(conf.splat.backend)
    what = provenance.collect(threads, backend)
    _write_struct(folder.path / "provenance.json", what)
    data = dataset.load(variant, conf.train.views, validation=conf.train.validation, seed=conf.seed)
    _log.info(
        "cell %s: variant %s, %d training views, %d points; xrgs %s, %s, %d threads",
        *(folder.id, variant.id, len(data.train), len(data.points)),
        *(what.xrgs, backend, threads),
    )
    # A search for a threshold trains several times, and only the last training is the cell's.
    searches = conf.components.count_matched.gaussians > 0
    checkpoint = CellCheckpoint(folder, conf.checkpoint_s, shown, stop, curves=not searches)
    trained, machines = _train_or_resume(data, conf, checkpoint, provenance.machine(what))
    if len(machines) > 1:
        what = msgspec.structs.replace(what, machines_in_turn="; ".join(machines))
        _write_struct(folder.path / "provenance.json", what)
    shown.note = ""
    count, findings = len(trained.gaussians), checkpoint.findings()
    _log.info("trained %d steps in %.1f s: %d Gaussians", conf.train.steps, trained.seconds, count)
    for line in findings:
        _log.info("%s", line)
    peak_rss_bytes = peak_rss()  # read before evaluation, which may load the network of LPIPS
    save_ply(
        folder.path / SPLATS,
        trained.gaussians,
        antialiased=conf.splat.raster.antialiased,
        durable=False,
        exact=True,  # the very Gaussians that are scored, so that they can be scored again
    )
    write_curves(folder, trained.history, trained.scores)
    render_time_ms = protocol.render_time(trained.gaussians, data.test, conf.splat)
    scores = protocol.score_views(trained.gaussians, data.test, conf.splat, folder.path / "renders")
    write_text(folder.path / "scores.csv", table_text(scores), durable=False)
    psnr = fmean(math.nan if row["psnr"] is None else row["psnr"] for row in scores)
    _log.info("evaluated %d views: mean PSNR %.2f dB", len(scores), psnr)
    summary = Summary(
        training_time_s=trained.seconds,
        render_time_ms=render_time_ms,
        gaussians=count,
        memory_bytes=trained.memory_bytes,
        peak_rss_bytes=peak_rss_bytes,
        evaluations=trained.evaluations,
        steps=conf.train.steps,
        grow_grad2d=trained.grow_grad2d,
        work=dict(trained.work),
        stage_seconds=dict(trained.stage_seconds),
        found=tuple(findings),
    )
    _write_struct(folder.path / "summary.json", summary)
    return [view.name for view in data.test]


def _train_or_resume(
    data: Dataset, conf: Conf, checkpoint: CellCheckpoint, here: str
) -> tuple[TrainingResult, list[str]]:
    """Train from the cell's checkpoint, or from the start if there is no usable one.

    Returns the result, and the names of the machines that trained, of which the last is `here`.
    """

    def evaluate(gaussians: Gaussians) -> dict[str, float | None]:
        return protocol.mean_scores(gaussians, data.test, conf.splat)

    def train_here() -> tuple[TrainingResult, list[str]]:
        machines = provenance.Machines(here)
        checkpoint.register(machines=machines)
        return train_cell(data, conf, checkpoint, evaluate), machines.names

    try:
        steps = checkpoint.load()
        if steps is not None:
            _log.info("going on from the checkpoint, %d steps done", steps)
        return train_here()
    except CheckpointError as error:
        _log.warning("training starts over: %s", error)
        checkpoint.set_aside()
    return train_here()


def _write_struct(file: Path, value: msgspec.Struct) -> None:
    write_json(file, msgspec.to_builtins(value), durable=False)
