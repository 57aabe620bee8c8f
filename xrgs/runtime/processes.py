"""Processes of this machine: when they started, whether they live, and the memory they use."""

from __future__ import annotations

import os
from contextlib import suppress
from functools import cache
from pathlib import Path

import psutil

#: Two readings of a process's start may differ by less than this many seconds: boot times are
#: rounded, and move with the clock. No later process has the same id so soon.
_START_S = 2.0


@cache
def boot() -> str:
    """Return an id of this boot and this process namespace; empty where the system has none."""
    try:
        boot_id = Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()
        return f"{boot_id} {Path('/proc/self/ns/pid').readlink()}"
    except OSError:
        return ""


def started(pid: int) -> float:
    """Return when a process started, in seconds after the boot."""
    # Not in seconds since the epoch: these change for a running process when the clock is set.
    return round(float(psutil.Process(pid).create_time() - psutil.boot_time()), 2)


def lives(pid: int, start: float) -> bool:
    """Return whether the process with this id and start exists, suspended or not.

    A zombie, which has ended and whose parent has not waited for it, does not live.
    """
    try:
        ended = psutil.Process(pid).status() in {psutil.STATUS_ZOMBIE, psutil.STATUS_DEAD}
        return not ended and abs(started(pid) - start) < _START_S
    except psutil.NoSuchProcess:
        return False


def resident_bytes(session: int) -> int:
    """Return the resident bytes of all processes of a session, by the id of its first process.

    Shared pages count for each.
    """
    total: int = 0
    for pid in psutil.pids():
        with suppress(ProcessLookupError, psutil.NoSuchProcess):  # it may end while it is read
            if os.getsid(pid) == session:
                total += psutil.Process(pid).memory_info().rss
    return total


def offer_to_oom_killer() -> None:
    """Let the kernel kill this process before others when the machine runs out of memory."""
    with suppress(OSError):
        Path("/proc/self/oom_score_adj").write_text("500", encoding="ascii")
