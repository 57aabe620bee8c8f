"""Tests of what is known of other processes."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from xrgs.runtime import processes


def test_a_process_is_told_from_others_by_its_start_until_it_is_dead() -> None:
    with subprocess.Popen([sys.executable, "-c", "import time; time.sleep(600)"]) as child:
        began = processes.started(child.pid)
        assert began is not None
        assert began >= (processes.started(os.getpid()) or 0)
        assert processes.started(child.pid) == began
        os.kill(child.pid, signal.SIGSTOP)
        assert processes.started(child.pid) == began
        child.kill()
        end = time.monotonic() + 10
        while processes.started(child.pid) is not None:  # nobody has waited for it
            assert time.monotonic() < end
            time.sleep(0.01)
    assert processes.started(child.pid) is None


def test_without_proc_a_process_exists_or_does_not(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    with subprocess.Popen([sys.executable, "-c", ""]) as child:
        pass
    monkeypatch.setattr(processes, "_PROC", tmp_path)
    assert not processes.proc_exists()
    assert processes.started(os.getpid()) == 0
    assert processes.started(child.pid) is None
    assert processes.boot.__wrapped__() == ""


def test_memory_is_that_of_all_processes_of_a_session() -> None:
    text = "x = b'x' * 50_000_000; print(flush=True); import time; time.sleep(600)"
    command = [sys.executable, "-c", text]
    with subprocess.Popen(command, stdout=subprocess.PIPE, start_new_session=True) as child:
        assert child.stdout is not None
        child.stdout.readline()
        assert 50e6 < processes.resident_bytes(child.pid) < 500e6
        child.kill()
    assert processes.resident_bytes(child.pid) == 0
