"""Ctrl-C and SIGTERM, seen from outside."""

from __future__ import annotations

import signal
import subprocess
import sys

import pytest

_SCRIPT = """
import signal, sys, time
from xrgs.runtime.signals import stoppable
if sys.argv[1] == "nohup":
    signal.signal(signal.SIGINT, signal.SIG_IGN)
with stoppable("Go on."):
    try:
        print("ready", flush=True)
        time.sleep(60 if sys.argv[1] != "nohup" else 0.5)
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
        heard = [process.stdout.readline()]
        for number in signals:
            process.send_signal(number)
            heard.append(process.stdout.readline())
        out, err = process.communicate()
    return process.returncode, "".join(heard) + out, err


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_signal_ends_it_in_order_and_says_how_to_go_on(number: signal.Signals, code: int) -> None:
    told = stopped("at once", number)
    assert told == (code, "ready\ntidied up\n", f"stopped by {number.name}. Go on.\n")


def test_the_second_one_ends_it_at_once() -> None:
    assert stopped("slow", signal.SIGINT, signal.SIGTERM)[0] == -signal.SIGTERM


def test_what_was_ignored_stays_ignored() -> None:
    assert stopped("nohup", signal.SIGINT) == (0, "ready\ntidied up\n", "")
