"""Tests that a process under limits ends with all that it started, whatever it does."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest

from xrgs.config import LimitsConf
from xrgs.errors import XrgsError
from xrgs.sweep import job
from xrgs.sweep.job import ProcessEnd

pytestmark = pytest.mark.slow

#: Starts a child of its own, writes both their numbers, refuses to end, and hangs.
_STUBBORN = """
import json, os, signal, subprocess, sys, time
from functools import partial
from pathlib import Path
from xrgs.sweep import job
job.follow_parent()
signal.signal(signal.SIGTERM, signal.SIG_IGN)
signal.signal(signal.SIGUSR1, signal.SIG_IGN)
child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(600)"])
file = Path(sys.argv[1])
file.with_suffix(".part").write_text(json.dumps([os.getpid(), child.pid]))
file.with_suffix(".part").rename(file)
time.sleep(600)
"""
_HUNGRY = """
import time
eaten = []
for _ in range(40):
    eaten.append(b"x" * 10_000_000)
    time.sleep(0.02)
"""


def python(script: str, *arguments: str) -> list[str]:
    return [sys.executable, "-c", script, *arguments]


def limits(minutes: float = 0, memory_gb: float = 0) -> LimitsConf:
    return LimitsConf(minutes=minutes, memory_gb=memory_gb)


def gone(pid: int) -> bool:
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return True
    return state in "ZX"


def wait(what: Callable[[], bool], seconds: float = 30.0) -> None:
    end = time.monotonic() + seconds
    while not what():
        assert time.monotonic() < end
        time.sleep(0.02)


def test_a_process_that_ends_by_itself_gives_its_code_or_signal() -> None:
    assert job.run_supervised(python("raise SystemExit(3)")) == ProcessEnd(3)
    script = "import os; os.kill(os.getpid(), 9)"
    assert job.run_supervised(python(script), limits(1, 1)) == ProcessEnd(-signal.SIGKILL)


def test_a_process_that_hangs_is_killed_with_its_children_though_it_ignores_sigterm(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(job, "_LIMIT_GRACE_S", 0.5)
    pids = tmp_path / "pids"
    ended = job.run_supervised(python(_STUBBORN, str(pids)), limits(minutes=0.1))
    assert "limits.minutes=0.1" in ended.reason
    for pid in json.loads(pids.read_text()):
        wait(partial(gone, pid))


def test_memory_is_that_of_the_process_and_its_children() -> None:
    eats = f"import subprocess, sys; subprocess.run([sys.executable, '-c', {_HUNGRY!r}])"
    ended = job.run_supervised(python(eats), limits(memory_gb=0.2))
    assert "limits.memory_gb=0.2" in ended.reason
    assert job.run_supervised(python(_HUNGRY), limits(memory_gb=4)).reason == ""


def test_an_exception_of_on_poll_ends_the_process() -> None:
    polled = []

    def on_poll(pid: int) -> None:
        polled.append(pid)
        if len(polled) == 2:
            raise XrgsError("enough")

    with pytest.raises(XrgsError, match="enough"):
        job.run_supervised(python("import time; time.sleep(600)"), None, on_poll)
    assert gone(polled[-1])


@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGTERM])
def test_no_child_outlives_its_parent(tmp_path: Path, how: signal.Signals) -> None:
    pids = tmp_path / "pids"
    script = (
        "import sys; from xrgs.sweep import job; job._GRACE_S = 0.1;"
        "job.run_supervised(sys.argv[1:])"
    )
    command = python(script, *python(_STUBBORN, str(pids)))
    with subprocess.Popen(command, stderr=subprocess.DEVNULL) as parent:
        wait(pids.exists)
        os.kill(parent.pid, how)
    for pid in json.loads(pids.read_text()):
        wait(partial(gone, pid))
