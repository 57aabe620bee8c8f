"""Tests of other processes: their starts, whether they live, and their memory."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time

import psutil
import pytest

from xrgs.runtime import machine


def test_a_process_is_told_from_others_by_its_start_until_it_is_dead() -> None:
    with subprocess.Popen([sys.executable, "-c", "import time; time.sleep(600)"]) as child:
        began = machine.started(child.pid)
        assert began >= machine.started(os.getpid())
        assert machine.started(child.pid) == began
        assert not machine.lives(child.pid, began - 10)
        os.kill(child.pid, signal.SIGSTOP)
        assert machine.lives(child.pid, began)
        child.kill()
        end = time.monotonic() + 10
        while machine.lives(child.pid, began):  # nobody has waited for it
            assert time.monotonic() < end
            time.sleep(0.01)
    assert not machine.lives(child.pid, began)
    with pytest.raises(psutil.NoSuchProcess):
        machine.started(child.pid)


def test_a_clock_that_is_set_changes_no_start(monkeypatch: pytest.MonkeyPatch) -> None:
    began, booted = machine.started(os.getpid()), psutil.boot_time()
    monkeypatch.setattr(psutil, "boot_time", lambda: booted + 3600)
    monkeypatch.setattr(psutil._psplatform, "boot_time", lambda: booted + 3600)
    assert machine.started(os.getpid()) == pytest.approx(began, abs=0.02)


def test_memory_is_that_of_all_processes_of_a_session() -> None:
    text = "x = b'x' * 50_000_000; print(flush=True); import time; time.sleep(600)"
    command = [sys.executable, "-c", text]
    with subprocess.Popen(command, stdout=subprocess.PIPE, start_new_session=True) as child:
        assert child.stdout is not None
        child.stdout.readline()
        assert 50e6 < machine.resident_bytes(child.pid) < 500e6
        child.kill()
    assert machine.resident_bytes(child.pid) == 0
