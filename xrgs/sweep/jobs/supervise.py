"""Runs a process under limits of time and memory; it never outlives its parent."""

from __future__ import annotations

import os
import signal
import subprocess
import time
from contextlib import suppress
from dataclasses import dataclass
from types import MappingProxyType
from typing import TYPE_CHECKING

from xrgs.runtime import processes
from xrgs.runtime.progress import log_line

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

#: Seconds between two polls of the child.
_POLL_S = 0.2
#: Seconds that the child has after SIGTERM to write its checkpoint; fewer after it has exceeded a
#: limit.
_GRACE_S, _LIMIT_GRACE_S = 60.0, 5.0
#: Seconds of waiting for the child's end after which a message says so.
_SILENT_S = 1.0
#: A child that has registered it with `faulthandler` writes its stack at this signal.
STACK_SIGNAL = signal.SIGUSR1
#: Waits for the end of its standard input, a pipe into which nothing is written, and then kills the
#: process group. It ignores the signals that ask the group to end.
_WATCHER = "trap '' TERM INT HUP; read -r _; kill -s KILL -- -$1"


@dataclass(frozen=True)
class Limits:
    """Limits of a process and all its children; 0 means no limit."""

    minutes: float = 0.0
    """Wall time, minutes."""
    memory_gb: float = 0.0
    """Resident memory of all processes together, in 10^9 bytes, read every 0.2 s. RLIMIT_AS is no
    substitute: torch alone maps several times the memory that it uses."""


@dataclass(frozen=True)
class ProcessEnd:
    """How a process ended."""

    code: int
    """Its exit code, or minus the number of the signal that ended it."""
    reason: str = ""
    """The limit that it exceeded; empty if it ended by itself."""


def run_supervised(
    command: Sequence[str],
    limits: Limits,
    on_poll: Callable[[int], None] = lambda _: None,
    environment: Mapping[str, str] = MappingProxyType({}),
) -> ProcessEnd:
    """Run a command, in a session of its own, until it ends or exceeds a limit.

    Its standard input is a pipe that ends when this process does (see `follow_parent`).

    Args:
        command: The program and its arguments.
        limits: The process and its children are ended when they exceed them.
        on_poll: Called repeatedly while the process runs, with its process id. An exception that
            it raises ends the process and is raised here.
        environment: Variables that the process has besides those of this process.
    """
    child = subprocess.Popen(  # noqa: S603
        command, stdin=subprocess.PIPE, start_new_session=True, env=os.environ | environment
    )
    reason = ""
    try:
        reason = _watch(child, limits, on_poll)
    finally:
        _end(child, exceeded=bool(reason))
    return ProcessEnd(child.returncode, reason)


def _watch(child: subprocess.Popen[bytes], limits: Limits, on_poll: Callable[[int], None]) -> str:
    """Wait until the child ends or exceeds a limit; return which limit, or nothing."""
    start, pause = time.monotonic(), 0.01
    while child.poll() is None:
        minutes = (time.monotonic() - start) / 60
        if limits.minutes and minutes > limits.minutes:
            return f"it took longer than limits.minutes={limits.minutes:g} and was ended"
        if (
            limits.memory_gb
            and (used := processes.resident_bytes(child.pid) / 1e9) > limits.memory_gb
        ):
            return (
                f"out of memory: it used {used:.2f} GB, more than "
                f"limits.memory_gb={limits.memory_gb:g}, and was ended"
            )
        on_poll(child.pid)
        time.sleep(pause)
        pause = min(_POLL_S, 1.5 * pause)
    return ""


def _end(child: subprocess.Popen[bytes], *, exceeded: bool) -> None:
    """End the child and its children, by SIGTERM first, so that they can end in order."""
    if child.poll() is None:
        if exceeded:  # its stack tells what took so long
            child.send_signal(STACK_SIGNAL)
        _signal(child, signal.SIGTERM)
        if exceeded:
            _ends_within(child, _LIMIT_GRACE_S)
        elif not _ends_within(child, min(_SILENT_S, _GRACE_S)):
            log_line(
                f"waiting at most {_GRACE_S:.0f} s for the cell to keep its state; another Ctrl-C"
                " ends it at once"
            )
            _ends_within(child, _GRACE_S)
    _signal(child, signal.SIGKILL)
    child.wait()
    if child.stdin is not None:
        child.stdin.close()


def _ends_within(child: subprocess.Popen[bytes], seconds: float) -> bool:
    with suppress(subprocess.TimeoutExpired):
        child.wait(seconds)
    return child.returncode is not None


def _signal(child: subprocess.Popen[bytes], number: int) -> None:
    # The group has no process any more, or none but zombies.
    with suppress(ProcessLookupError, PermissionError):
        os.killpg(child.pid, number)


def follow_parent() -> None:
    """End this child and its children when the parent has ended.

    An orphan would go on writing to a cell whose lease is free. A shell process waits for the end
    of the pipe on standard input. A thread could not end a child that hangs in native code with the
    interpreter's lock, and PR_SET_PDEATHSIG would spare the child's children.
    """
    if os.getpgrp() != os.getpid():
        return  # started by hand: the process group is the shell's
    subprocess.Popen(["/bin/sh", "-c", _WATCHER, "sh", str(os.getpid())])  # noqa: S603
