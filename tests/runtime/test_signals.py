"""Ctrl-C and SIGTERM, sent to a child process."""

from __future__ import annotations

import signal
import subprocess
import sys

import pytest

from tests.runtime.programs import run_python

_SCRIPT = """
import signal, sys, time
from xrgs.runtime.signals import exit_on_signal
if sys.argv[1] == "nohup":
    signal.signal(signal.SIGINT, signal.SIG_IGN)
with exit_on_signal("Run it again."):
    try:
        print("ready", flush=True)
        for _ in range(600 if sys.argv[1] != "nohup" else 5):
            time.sleep(0.1)  # short: a signal right before a sleep is handled after it
    finally:
        print("tidied up", flush=True)
        if sys.argv[1] == "slow":
            time.sleep(60)
"""


def stopped(how: str, *signals: signal.Signals) -> tuple[int, str, str]:
    """Exit code, stdout and stderr of a process that gets the signals one after another."""
    command = [sys.executable, "-c", _SCRIPT, how]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        lines = [process.stdout.readline()]
        for number in signals:
            process.send_signal(number)
            lines.append(process.stdout.readline())
        out, err = process.communicate()
    return process.returncode, "".join(lines) + out, err


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_signal_ends_the_block_in_order_and_prints_the_hint(
    number: signal.Signals, code: int
) -> None:
    result = stopped("at once", number)
    assert result == (code, "ready\ntidied up\n", f"stopped by {number.name}. Run it again.\n")


def test_a_second_signal_ends_the_process_at_once() -> None:
    assert stopped("slow", signal.SIGINT, signal.SIGTERM)[0] == -signal.SIGTERM


@pytest.mark.slow
def test_an_ignored_signal_stays_ignored() -> None:
    assert stopped("nohup", signal.SIGINT) == (0, "ready\ntidied up\n", "")


@pytest.mark.slow
def test_colmap_leaves_the_handlers_of_signals_as_they_were() -> None:
    """COLMAP's log library takes SIGTERM and the signals of crashes, and prints a stack at them."""
    script = """
import faulthandler, os, signal, threading
faulthandler.enable()
def imported():
    {imports}
threading.Thread(target=imported).start() if {thread} else imported()
[thread.join() for thread in threading.enumerate() if thread is not threading.current_thread()]
os.kill(os.getpid(), signal.{name})
"""
    distorted = "Lens('SIMPLE_RADIAL', (9, 4, 3, 0.1), 8, 6)"
    for imports, name, thread, said in (
        ("from xrgs.mixture import colmap", "SIGTERM", 1, ""),
        ("from xrgs.mixture import sfm", "SIGABRT", 0, "Fatal Py"),
        (f"from xrgs.photos.lens import Lens; {distorted}.kept()", "SIGTERM", 0, ""),
    ):
        done = run_python(script.format(imports=imports, name=name, thread=thread))
        assert done.returncode == -getattr(signal, name)
        assert done.stderr.startswith(said)
        assert "***" not in done.stderr
