"""Tests of a cell: its views, its files, and how it resumes after a kill."""

from __future__ import annotations

import logging
import random
import shutil
import signal
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import msgspec
import pytest

from tests.store.cells import begun
from xrgs.config import TRAINING_VIEWS, Conf
from xrgs.evaluation import protocol
from xrgs.evaluation.metrics import VIEW_METRICS
from xrgs.mixture.views import Variant
from xrgs.runtime import progress
from xrgs.runtime.signals import StopRequest, StopSignal
from xrgs.safeio.records import read_table
from xrgs.splat.backend import resolve_backend
from xrgs.store import cell
from xrgs.store.cell_folder import CellFolder
from xrgs.store.identity import cell_id, cell_identity
from xrgs.training import dataset
from xrgs.training import loop as train
from xrgs.training.dataset import Dataset

#: Stands in for a variant that is never read.
VARIANT = cast(Variant, SimpleNamespace(id="v"))


@pytest.mark.slow
def test_the_controls_choose_the_views_that_are_trained_on_and_scored(
    compose: Callable[..., Conf], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def load(variant: object, use: str, *, validation: float, seed: int) -> None:
        raise RuntimeError(f"{use} {validation} {seed}")

    monkeypatch.setattr(dataset, "load", load)
    for ablation in ("baseline", *TRAINING_VIEWS[1:]):
        views = "mixed" if ablation == "baseline" else ablation
        conf = compose(f"+ablation={ablation}", "train.validation=0.1", "seed=7")
        with pytest.raises(RuntimeError, match=rf"^{views} 0\.1 7$"):
            cell.run_cell(conf, VARIANT, CellFolder(tmp_path))
        assert "Traceback" in (tmp_path / "error.txt").read_text()


class Kill(BaseException):
    """Stands in for a kill; no code may catch it."""


def kill_at(monkeypatch: pytest.MonkeyPatch, module: Any, name: str, call: int) -> None:
    """Let the n-th call of a function raise `Kill`; all others are unchanged."""
    real, calls = getattr(module, name), [0]

    def mortal(*arguments: Any, **named: Any) -> Any:
        calls[0] += 1
        if calls[0] == call:
            raise Kill
        return real(*arguments, **named)

    monkeypatch.setattr(module, name, mortal)


def begin(conf: Conf, root: Path, variant_id: str = "v") -> CellFolder:
    """Begin a cell's folder as a job does."""
    what = cell_identity(conf, variant_id)
    return begun(CellFolder(root / cell_id(what)), conf, what)


def results(folder: CellFolder) -> dict[str, Any]:
    """Return all results of a cell except times and this machine's memory."""
    assert folder.state().name == "done", folder.state().reason
    assert not folder.checkpoint.exists()
    names = ["splats.ply", "history.csv", "scores.csv"]
    names += [f"renders/{file.name}" for file in sorted((folder.path / "renders").iterdir())]
    summary = msgspec.structs.asdict(folder.summary())
    assert summary.pop("render_time_ms") > 0
    del summary["training_time_s"], summary["stage_seconds"], summary["peak_rss_bytes"]
    return {name: (folder.path / name).read_bytes() for name in names} | summary


@pytest.fixture
def conf(data: Dataset, baseline: Conf, monkeypatch: pytest.MonkeyPatch) -> Conf:
    """The config of a cell on `data` that writes a checkpoint after each step."""
    monkeypatch.setattr(dataset, "load", lambda *_, **__: data)
    baseline.checkpoint_s, baseline.threads = 1e-9, 1
    baseline.train.steps, baseline.splat.backend = 12, resolve_backend("auto")
    return baseline


def killed(conf: Conf, root: Path, step: int) -> CellFolder:
    """Return the folder of a cell whose process was killed during a step."""
    folder = begin(conf, root)
    with pytest.MonkeyPatch.context() as patch:
        kill_at(patch, train, "photometric_loss", step + 1)
        with pytest.raises(Kill):
            cell.run_cell(conf, VARIANT, folder)
    assert folder.checkpoint.exists() == (step > 0)
    return folder


def whole(conf: Conf, root: Path) -> dict[str, Any]:
    """Return the results of the cell if it is not killed."""
    folder = begin(conf, root)
    cell.run_cell(conf, VARIANT, folder)
    return results(folder)


@pytest.mark.slow
def test_a_cell_killed_in_training_and_again_in_evaluation_goes_on(
    conf: Conf,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    step = random.randrange(1, conf.train.steps)
    killed(conf, tmp_path / "a", step)
    with monkeypatch.context() as patch:
        kill_at(patch, protocol, "score_views", 1)
        with pytest.raises(Kill):
            cell.run_cell(conf, VARIANT, begin(conf, tmp_path / "a"))
    folder = begin(conf, tmp_path / "a")
    with caplog.at_level(logging.INFO):
        cell.run_cell(conf, VARIANT, folder)
    assert f"going on from the checkpoint, {conf.train.steps} steps done" in caplog.text
    assert results(folder) == whole(conf, tmp_path / "b"), step
    assert [path.name for path in folder.path.parent.iterdir()] == [folder.id]  # nothing aside


@pytest.mark.slow
def test_a_cell_that_goes_on_elsewhere_names_both_machines(conf: Conf, tmp_path: Path) -> None:
    killed(conf, tmp_path, 6)
    several = ["threads 1", "threads 2"]
    for conf.threads in (2, 1, 2):  # here, where it began, and here again
        folder = begin(conf, tmp_path)
        with pytest.MonkeyPatch.context() as patch:
            kill_at(patch, protocol, "score_views", 1)
            with pytest.raises(Kill):
                cell.run_cell(conf, VARIANT, folder)
        found = folder.provenance().machines_in_turn.split("; ")
        assert len(found) == 2
        assert all(word in name for word, name in zip(several, found, strict=True))
    # Where training starts over, the last machine is the only one.
    _truncate(folder.checkpoint, folder.checkpoint)
    folder = begin(conf, tmp_path)
    cell.run_cell(conf, VARIANT, folder)
    assert not folder.provenance().machines_in_turn


def _truncate(checkpoint: Path, other: Path) -> None:
    checkpoint.write_bytes(checkpoint.read_bytes()[:-1000])


def _exchange(checkpoint: Path, other: Path) -> None:
    shutil.copy(other, checkpoint)


@pytest.mark.slow
@pytest.mark.parametrize(("spoil", "message"), [(_truncate, "not a zip"), (_exchange, "to cell")])
def test_an_unusable_checkpoint_is_logged_and_training_starts_over(
    conf: Conf,
    tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
    spoil: Callable[[Path, Path], None],
    message: str,
) -> None:
    folder = killed(conf, tmp_path / "a", 9)
    conf.seed = 1
    other = killed(conf, tmp_path / "other", 9)
    conf.seed = 0
    spoil(folder.checkpoint, other.checkpoint)
    folder = begin(conf, tmp_path / "a")
    with caplog.at_level(logging.WARNING):
        cell.run_cell(conf, VARIANT, folder)
    assert "training starts over" in caplog.text
    assert message in caplog.text
    assert (folder.path / "refused-checkpoint.npz").exists()
    assert results(folder) == whole(conf, tmp_path / "b")


@pytest.mark.slow
def test_the_test_views_are_scored_during_training_and_nothing_else_changes(
    conf: Conf, tmp_path: Path
) -> None:
    plain = begin(conf, tmp_path / "plain")
    cell.run_cell(conf, VARIANT, plain)
    assert not (plain.path / "quality.csv").exists()
    conf.train.evaluate_every = 5
    scored = begin(conf, tmp_path / "scored")
    cell.run_cell(conf, VARIANT, scored)
    assert results(scored) == results(plain)
    header, rows = read_table(scored.path / "quality.csv")
    assert header == ["step", "seconds", "evaluations", "gaussians", *VIEW_METRICS]
    table = [dict(zip(header, row, strict=True)) for row in rows]
    assert [row["step"] for row in table] == ["5", "10"]
    assert all(float(row["psnr"]) > 0 for row in table)
    assert "quality.csv" in scored.status().files


@pytest.mark.parametrize("searches", [False, True])
def test_the_curves_are_written_while_a_cell_trains(
    conf: Conf, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, searches: bool
) -> None:
    """Though not of a search, of whose trainings the last one alone is the cell's."""
    monkeypatch.setattr(cell, "_CURVES_S", 0.0)
    conf.train.evaluate_every = 4
    if searches:
        conf.components.count_matched.gaussians = 10
    folder = killed(conf, tmp_path, 6)
    assert (folder.path / "history.csv").exists() == (not searches)
    if not searches:
        header, rows = read_table(folder.path / "history.csv")
        assert [row[header.index("step")] for row in rows] == [str(step) for step in range(6)]
        header, rows = read_table(folder.path / "quality.csv")
        assert [row[header.index("step")] for row in rows] == ["4"]
        assert folder.state().name == "unfinished"


def test_what_components_found_is_in_the_summary(
    conf: Conf, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    conf.components.exposure.mode = "gain"
    folder = begin(conf, tmp_path)
    with caplog.at_level(logging.INFO):
        cell.run_cell(conf, VARIANT, folder)
    (found,) = folder.summary().found
    assert found.startswith("exposure: the gains of the photographs are ")
    assert found in caplog.text


def test_a_cell_that_is_asked_to_end_keeps_every_step_and_says_what_happened(
    conf: Conf, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Though its checkpoints are hours apart; and the next attempt ends as an undisturbed one."""
    conf.checkpoint_s = 9999.0
    expected = whole(conf, tmp_path / "whole")
    folder, stop = begin(conf, tmp_path / "stopped"), StopRequest()
    loop: Any = train
    real, calls = loop.photometric_loss, [0]

    def signalled(*arguments: Any, **named: Any) -> Any:
        calls[0] += 1
        if calls[0] == 5:
            stop._on_signal(signal.SIGTERM, None)
        return real(*arguments, **named)

    with monkeypatch.context() as patch:
        patch.setattr(train, "photometric_loss", signalled)
        with pytest.raises(StopSignal):
            cell.run_cell(conf, VARIANT, folder, stop)
    assert folder.state().name == "unfinished"
    assert not (folder.path / "error.txt").exists()
    assert not folder.progress.exists()
    with caplog.at_level(logging.INFO):
        cell.run_cell(conf, VARIANT, begun(folder, conf, folder.identity()))
    assert results(folder) == expected
    for line in ("going on from the checkpoint, 5 steps done", "trained 12 steps in", "mean PSNR"):
        assert line in caplog.text


def test_a_cell_without_checkpoints_ends_at_once_and_writes_none(
    conf: Conf, tmp_path: Path
) -> None:
    conf.checkpoint_s = 0.0
    folder, stop = begin(conf, tmp_path / "stopped"), StopRequest()
    stop.received = True
    with pytest.raises(StopSignal):
        cell.run_cell(conf, VARIANT, folder, stop)
    assert not folder.checkpoint.exists()


def test_the_progress_of_a_cell_has_its_gaussians_and_its_loss(
    conf: Conf, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen = []
    monkeypatch.setattr(progress, "_FILE_S", 0.0)
    monkeypatch.setattr(
        progress, "write_json", lambda _, state, **__: seen.append(progress.Progress(**state))
    )
    folder = begin(conf, tmp_path / "shown")
    cell.run_cell(conf, VARIANT, folder)
    history = folder.history()
    mean = history["loss"].iloc[:6].mean()  # of the steps so far, up to ten
    (at,) = [now for now in seen if now.what == "training" and now.done == 6]
    assert at.note == f"{history['gaussians'].iloc[5]:,} Gaussians, loss {mean:.3g}"
    assert str(at).startswith(f"training 6 of 12 steps, {at.note}, ")
    assert {now.note for now in seen if now.what != "training"} == {""}
