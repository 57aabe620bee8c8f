"""Tests of a worker that is suspended until another process has taken its cell over."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.sweep.conftest import VARIANT, content
from xrgs.config import Conf
from xrgs.safeio.atomic import write_json
from xrgs.splat.backend import resolve_backend
from xrgs.store.attempts import begin_attempt, plan_cell
from xrgs.store.cell_folder import CellFolder
from xrgs.store.identity import cell_identity
from xrgs.store.store import Store
from xrgs.sweep import job

#: Runs a worker that stops itself right before it writes a cell's status.
STOPPED = """
import os, signal, sys
from pathlib import Path
replace = Path.replace

def stopping(path, target):
    if str(target).endswith("status.json"):
        Path.replace = replace
        os.kill(os.getpid(), signal.SIGSTOP)
    return replace(path, target)

Path.replace = stopping
from xrgs.sweep import job
job.main("cell", *sys.argv[1:])
"""


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


@pytest.mark.slow
def test_a_worker_that_wakes_up_after_a_takeover_writes_into_its_own_folder_alone(
    begin: Callable[[str], CellFolder], smoke_variants: Path, tmp_path: Path
) -> None:
    (built,) = smoke_variants.iterdir()
    cell = begin(built.name)
    write_json(tmp_path / "request", job.cell_request(built, cell))
    arguments = [str(tmp_path / "request"), str(tmp_path / "answer")]
    child = subprocess.Popen([sys.executable, "-P", "-c", STOPPED, *arguments])
    assert os.WIFSTOPPED(os.waitpid(child.pid, os.WUNTRACED)[1])

    own = tmp_path / "own"
    cell.path.rename(own)  # a test can look into it; an attempt would remove it
    plan_cell(cell, CellFolder(own).config(), CellFolder(own).identity())
    begin_attempt(cell)
    (cell.path / "scores.csv").write_text("view\na\n")
    cell.finish(["a"], {})
    before = content(cell.path)
    child.send_signal(signal.SIGCONT)
    child.wait(60)
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
