"""Runs one cell: trains a variant with a config and a seed, scores it and writes the results."""

from __future__ import annotations

import logging
import traceback
from typing import TYPE_CHECKING

from xrgs.capture import dataset
from xrgs.evaluation import protocol
from xrgs.experiment import provenance
from xrgs.runtime import progress
from xrgs.runtime.machine import peak_rss, set_torch_threads
from xrgs.safeio.atomic import write_json, write_text
from xrgs.safeio.hashing import digest
from xrgs.safeio.records import table_text
from xrgs.safeio.words import for_terminal
from xrgs.splat.backend import resolve_backend
from xrgs.splat.ply import save_ply
from xrgs.training.checkpoint import Checkpoint, CheckpointError
from xrgs.training.count_matching import train_cell

if TYPE_CHECKING:
    from xrgs.capture.dataset import Dataset
    from xrgs.capture.views import Variant
    from xrgs.config import Conf
    from xrgs.experiment.cell_folder import CellFolder
    from xrgs.splat.gaussians import Gaussians
    from xrgs.training.recorder import TrainingResult

_log = logging.getLogger(__name__)


def run_cell(conf: Conf, variant: Variant, folder: CellFolder) -> None:
    """Train and evaluate a cell, and write its results; its status is written last.

    Args:
        conf: The cell's config.
        variant: The frozen variant that it trains on.
        folder: The cell's folder, in which `CellFolder.begin` has written config and identity.

    Raises:
        Exception: Whatever went wrong, after its traceback was written to `error.txt`.
    """
    try:
        with progress.written_to(folder.progress):
            views = _train_and_score(conf, variant, folder)
        folder.finish(views, protocol.PROTOCOL_VERSION)
    except Exception:
        write_text(folder.folder / "error.txt", for_terminal(traceback.format_exc()))
        raise


def _train_and_score(conf: Conf, variant: Variant, folder: CellFolder) -> list[str]:
    """Write every file but the status; return the names of the views that were scored.

    None of the files is waited for until it is on the disk: `CellFolder.finish` does that.
    """
    threads = set_torch_threads(conf.threads)
    backend = resolve_backend(conf.splat.backend)
    what = provenance.collect(threads, backend)
    write_json(folder.folder / "provenance.json", what, durable=False)
    data = dataset.load(variant, conf.train.views, validation=conf.train.validation, seed=conf.seed)
    trained = _train_or_resume(data, conf, folder)
    peak_rss_bytes = peak_rss()  # read before evaluation, which may load the network of LPIPS
    save_ply(folder.folder / "splats.ply", trained.gaussians, durable=False)
    write_text(folder.folder / "history.csv", table_text(trained.history), durable=False)
    if trained.scores:
        write_text(folder.folder / "quality.csv", table_text(trained.scores), durable=False)
    render_time_ms = protocol.render_time(trained.gaussians, data.test, conf.splat)
    scores = protocol.score_views(
        trained.gaussians, data.test, conf.splat, folder.folder / "renders"
    )
    write_text(folder.folder / "scores.csv", table_text(scores), durable=False)
    write_json(
        folder.folder / "summary.json",
        {
            "training_time_s": trained.seconds,
            "render_time_ms": render_time_ms,
            "gaussians": len(trained.gaussians),
            "memory_bytes": trained.memory_bytes,
            "peak_rss_bytes": peak_rss_bytes,
            "evaluations": trained.evaluations,
            "steps": conf.train.steps,
            "grow_grad2d": trained.grow_grad2d,
            "work": trained.work,
            "stage_seconds": trained.stage_seconds,
        },
        durable=False,
    )
    return [view.name for view in data.test]


def _train_or_resume(data: Dataset, conf: Conf, folder: CellFolder) -> TrainingResult:
    """Train from the cell's checkpoint, or from the start if there is no usable one."""

    def evaluate(gaussians: Gaussians) -> dict[str, float | None]:
        return protocol.mean_scores(gaussians, data.test, conf.splat)

    checkpoint = Checkpoint(folder.checkpoint, digest(folder.identity()), conf.checkpoint_s)
    try:
        steps = checkpoint.load()
        if steps is not None:
            _log.info("going on from the checkpoint, %d steps done", steps)
        return train_cell(data, conf, checkpoint, evaluate)
    except CheckpointError as error:
        _log.warning("training starts over: %s", error)
        checkpoint.set_aside()
    return train_cell(data, conf, checkpoint, evaluate)
