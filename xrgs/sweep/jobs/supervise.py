"""A process under limits of time and memory, which never outlives the one that started it."""

from __future__ import annotations

import os
import signal
import subprocess
import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from xrgs.errors import XrgsError

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

#: Seconds between looks at the child, and how long it has after SIGTERM to end by itself.
_LOOK_S = 0.2
_GRACE_S = 5.0
#: Nothing is ever written to the pipe: `read` returns at its end. The group asked to end keeps it.
_WATCHER = "trap '' TERM INT HUP; read -r _; kill -s KILL -- -$1"


@dataclass(frozen=True)
class Limits:
    """What a process and its children may take; 0 is no limit."""

    minutes: float = 0.0
    memory_gb: float = 0.0
    """10^9 bytes of resident memory of all of them together, read every 0.2 s: what is allocated
    and never touched costs nothing. Not RLIMIT_AS: torch alone maps several times what it uses."""


@dataclass(frozen=True)
class Ended:
    """How a process ended."""

    code: int
    """Its exit code, or minus the signal that ended it."""
    reason: str = ""
    """Which limit it was ended at; empty where it ended by itself."""


def run(
    command: Sequence[str], limits: Limits, on_poll: Callable[[int], None] = lambda _: None
) -> Ended:
    """Run a command to its end, or to its limit, with a session of its own.

    Its standard input is a pipe that ends when this process does (`follow_parent`).

    Args:
        command: program and arguments.
        limits: it and its children are ended where they go beyond.
        on_poll: called again and again while it runs, with its process number; what it raises
            ends it, and is raised here.

    Raises:
        XrgsError: memory is limited on a system that doesn't tell how much a process has.
    """
    if limits.memory_gb and not Path("/proc/self/statm").exists():
        raise XrgsError(f"limits.memory_gb={limits.memory_gb:g}: this system has no /proc")
    child = subprocess.Popen(command, stdin=subprocess.PIPE, start_new_session=True)  # noqa: S603
    try:
        reason = _watch(child, limits, on_poll)
    finally:
        _end(child)
    return Ended(child.returncode, reason)


def _watch(child: subprocess.Popen[bytes], limits: Limits, on_poll: Callable[[int], None]) -> str:
    """Wait for its end; why it has to be ended, or empty."""
    start, pause = time.monotonic(), 0.01
    while child.poll() is None:
        minutes = (time.monotonic() - start) / 60
        if limits.minutes and minutes > limits.minutes:
            return f"it took longer than limits.minutes={limits.minutes:g} and was ended"
        if limits.memory_gb and (used := _resident_bytes(child.pid) / 1e9) > limits.memory_gb:
            return (
                f"out of memory: it used {used:.2f} GB, more than "
                f"limits.memory_gb={limits.memory_gb:g}, and was ended"
            )
        on_poll(child.pid)
        time.sleep(pause)
        pause = min(_LOOK_S, 1.5 * pause)
    return ""


def _end(child: subprocess.Popen[bytes]) -> None:
    """End it and whatever it started: asked first, so that its log can say where it was."""
    if child.poll() is None:
        _signal(child, signal.SIGTERM)
        with suppress(subprocess.TimeoutExpired):
            child.wait(_GRACE_S)
    _signal(child, signal.SIGKILL)
    child.wait()
    if child.stdin is not None:
        child.stdin.close()


def _signal(child: subprocess.Popen[bytes], number: int) -> None:
    with suppress(ProcessLookupError, PermissionError):  # all gone; or but the dead are left
        os.killpg(child.pid, number)


def _resident_bytes(session: int) -> int:
    """Resident memory of every process of a session; pages that they share count for each."""
    page, total = os.sysconf("SC_PAGE_SIZE"), 0
    for folder in Path("/proc").iterdir():
        if folder.name.isdecimal():
            with suppress(OSError, IndexError):  # it may end while it is looked at
                stat = (folder / "stat").read_text(encoding="utf-8", errors="replace")
                if int(stat.rpartition(")")[2].split()[3]) == session:
                    total += page * int((folder / "statm").read_text(encoding="ascii").split()[1])
    return total


def follow_parent() -> None:
    """In the child: end, with all its children, when the process that started it is no more.

    An orphan that went on would write to a cell which by its lock is nobody's. A process of its own
    waits for the pipe's end, so that a child that hangs in native code ends too. It is the shell: a
    thread would want the interpreter, and PR_SET_PDEATHSIG leaves the child's children.
    """
    if os.getpgrp() != os.getpid():
        return  # started by hand: its group is the shell's
    subprocess.Popen(["/bin/sh", "-c", _WATCHER, "sh", str(os.getpid())])  # noqa: S603


def offer_to_oom_killer() -> None:
    """In the child: where the machine runs out of memory, this process goes, not the sweep."""
    with suppress(OSError):
        Path("/proc/self/oom_score_adj").write_text("500", encoding="ascii")
