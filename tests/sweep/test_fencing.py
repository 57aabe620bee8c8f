"""Tests of a worker that is suspended until another process has taken its cell over."""

from __future__ import annotations

import os
import shutil
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from tests.sweep.conftest import VARIANT, content
from xrgs.config import Conf
from xrgs.splat.backend import resolve_backend
from xrgs.store.attempts import begin_attempt, plan_cell
from xrgs.store.cell_folder import CellFolder
from xrgs.store.identity import cell_identity
from xrgs.store.store import Store
from xrgs.sweep import job


@pytest.fixture
def begin(compose: Callable[..., Conf], tmp_path: Path) -> Callable[[str], CellFolder]:
    """(variant) -> a begun cell of two steps, which writes a checkpoint after each of them."""

    def begun(variant_id: str) -> CellFolder:
        changes = ("scene=motorcycle", "preset=smoke", "train.steps=2", "threads=1")
        conf = compose(*changes, "checkpoint_s=1e-9")
        conf.splat.backend = resolve_backend(conf.splat.backend)
        store = Store(tmp_path / "s")
        store.prepare()
        cell = store.cell("c")
        plan_cell(cell, conf, cell_identity(conf, variant_id))
        begin_attempt(cell)
        return cell

    return begun


@contextmanager
def process_kept() -> Iterator[None]:
    """Give this process back its output and its handler of SIGTERM after a block."""
    handler, streams = signal.getsignal(signal.SIGTERM), [(os.dup(n), n) for n in (1, 2)]
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, handler)
        for kept, number in streams:
            os.dup2(kept, number)
            os.close(kept)


@pytest.mark.slow
def test_a_worker_that_wakes_up_after_a_takeover_writes_into_its_own_folder_alone(
    begin: Callable[[str], CellFolder],
    smoke_variants: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """It sleeps right before it writes the cell's status, while another finishes the cell."""
    (built,) = smoke_variants.iterdir()
    cell, own, replace = begin(built.name), tmp_path / "own", Path.replace
    request, before = job.cell_request(built, cell), {}

    def replace_late(path: Path, target: Path) -> Path:
        if Path(target).name == "status.json":
            monkeypatch.setattr(Path, "replace", replace)
            cell.path.rename(own)  # a test can look into it; an attempt would remove it
            plan_cell(cell, CellFolder(own).config(), CellFolder(own).identity())
            begin_attempt(cell)
            (cell.path / "scores.csv").write_text("view\na\n")
            cell.finish(["a"], {})
            before.update(content(cell.path))
        return replace(path, target)

    monkeypatch.setattr(Path, "replace", replace_late)
    monkeypatch.chdir(tmp_path)  # which is left at the end
    monkeypatch.setattr(job, "log_to_stderr", lambda *_: None)
    with process_kept():
        job._WORK["cell"](request)
    assert before
    assert content(cell.path) == before
    assert cell.state().name == "done"
    assert CellFolder(own).state().name == "done"  # where nobody looks any more


def test_a_worker_that_starts_after_a_takeover_does_nothing(
    begin: Callable[[str], CellFolder], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its parent was suspended between the beginning of the cell and the start of this worker."""
    cell = begin(VARIANT)
    monkeypatch.chdir(tmp_path)  # which is left at the end
    request = job.cell_request(tmp_path / VARIANT, cell)
    begin_attempt(cell)
    before = content(cell.path)
    for _ in range(2):  # another folder has its name, and then none
        with pytest.raises(job.WorkError, match="another attempt at the cell has begun"):
            job._WORK["cell"](request)
        assert content(cell.path) == before
        shutil.rmtree(cell.path, ignore_errors=True)
        before = {}
