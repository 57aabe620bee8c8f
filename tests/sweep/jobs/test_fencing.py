"""Tests of a worker that is suspended until another process has taken its cell over."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pytest

from xrgs.capture import variant
from xrgs.capture.views import Variant
from xrgs.config import Conf
from xrgs.experiment.attempts import begin_attempt
from xrgs.experiment.cell_folder import CellFolder
from xrgs.experiment.store import Store
from xrgs.safeio.atomic import write_json, write_text
from xrgs.splat.backend import resolve_backend
from xrgs.sweep.jobs import worker

pytestmark = pytest.mark.slow

#: Runs a worker that stops itself right before it calls a function of `os` for a file.
STOPPED = """
import os, signal, sys
name, file, request, answer = sys.argv[1:]
call = getattr(os, name)

def stopping(*arguments, **named):
    if any(str(argument).startswith(file) for argument in arguments):
        os.kill(os.getpid(), signal.SIGSTOP)
    return call(*arguments, **named)

setattr(os, name, stopping)
from xrgs.sweep.jobs import worker
worker.main("cell", request, answer)
"""


@pytest.fixture(scope="module")
def conf(compose: Callable[..., Conf]) -> Conf:
    """The config of a cell that writes a checkpoint after each of two steps."""
    changes = ("scene=motorcycle", "preset=smoke", "train.steps=2", "threads=1")
    conf = compose(*changes, "checkpoint_s=1e-9")
    conf.splat.backend = resolve_backend(conf.splat.backend)
    return conf


@pytest.fixture(scope="module")
def built(conf: Conf, tmp_path_factory: pytest.TempPathFactory) -> Variant:
    """The cell's variant."""
    store = Store(tmp_path_factory.mktemp("built") / "s")
    store.prepare()
    return variant.build(conf.scene, conf.variant, store.variants, store.scenes)


def files(folder: Path) -> dict[str, tuple[int, bytes]]:
    """Time and content of every file."""
    found = [file for file in folder.rglob("*") if file.is_file()]
    return {file.name: (file.stat().st_mtime_ns, file.read_bytes()) for file in found}


@pytest.mark.parametrize(
    ("call", "file", "done"),
    [
        ("open", ".status.json", False),
        ("rename", ".status.json", True),  # its status is written, but does not have its name yet
        ("rename", ".checkpoint.npz", False),
    ],
)
def test_a_worker_that_wakes_up_after_a_takeover_changes_nothing_and_says_so(
    conf: Conf, built: Variant, tmp_path: Path, call: str, file: str, done: bool
) -> None:
    store, identity = Store(tmp_path), {"variant": built.id, "seed": 0}
    store.prepare()
    first = begin_attempt(store.cell("c"), asdict(conf), identity)
    write_json(tmp_path / "request", worker.cell_request(asdict(conf), built.folder, first))
    arguments = [call, file, str(tmp_path / "request"), str(tmp_path / "answer")]
    child = subprocess.Popen([sys.executable, "-P", "-c", STOPPED, *arguments])
    assert os.WIFSTOPPED(os.waitpid(child.pid, os.WUNTRACED)[1])

    second = begin_attempt(store.cell("c"), asdict(conf), identity)
    if done:
        finish(second)
    before = files(second.path)
    child.send_signal(signal.SIGCONT)
    assert child.wait(60) == os.EX_TEMPFAIL
    answer = json.loads((tmp_path / "answer").read_text())
    assert answer["lost"] is True
    assert f"{second.path}: it was replaced" in answer["error"]
    assert "another attempt at the cell has begun" in answer["error"]
    assert files(second.path) == before
    assert second.state().name == ("done" if done else "unfinished")
    assert store.cells_folder.names() == ["c"]


def finish(attempt: CellFolder) -> None:
    write_text(attempt.folder / "scores.csv", "view\na\n")
    attempt.finish(["a"], 1)


def test_a_worker_that_starts_after_a_takeover_does_nothing(
    conf: Conf, built: Variant, tmp_path: Path
) -> None:
    """Its parent was suspended between the beginning of the cell and the start of this worker."""
    store, identity = Store(tmp_path), {"variant": built.id, "seed": 0}
    store.prepare()
    first = begin_attempt(store.cell("c"), asdict(conf), identity)
    request: dict[str, Any] = worker.cell_request(asdict(conf), built.folder, first)
    second = begin_attempt(store.cell("c"), asdict(conf), identity)
    before = files(second.path)
    with pytest.raises(worker.AttemptLostError, match="another attempt at the cell has begun"):
        worker.run_in_child("cell", request)
    assert files(second.path) == before
