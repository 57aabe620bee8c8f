"""Runs a function in a forked process under limits, and measures it.

Forking a process that has imported the commands takes milliseconds, starting a command a second.
The fork has the rights of an ordinary user: root's, to read what the mode of a file forbids, are
dropped.
"""

from __future__ import annotations

import ctypes
import os
import resource
import signal
import struct
import sys
import time
import traceback
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

#: Of the address space beyond what the parent has, so that a bomb does not harm the machine. It is
#: far above the limit that is judged, since threads and libraries reserve more than they use.
_ADDRESS_SPACE = 6 << 30
_POLL_S = 0.002
_CAPABILITY_VERSION = 0x20080522
#: CAP_DAC_OVERRIDE and CAP_DAC_READ_SEARCH.
_OVERRIDES = 0b110


@dataclass(frozen=True)
class Ended:
    """How a process ended, and what it used."""

    code: int
    """The exit code; minus the number of a signal."""
    output: bytes
    """stdout and stderr."""
    wall_s: float
    cpu_s: float
    peak_rss: int
    """Bytes, the process's children included, each on its own."""
    hung: bool
    """Whether it was killed at the limit of time."""


def run(function: Callable[[], None], folder: Path, wall_s: float) -> Ended:
    """Run a function in a forked process.

    Args:
        function: What to run; what it raises is handled as Python does at the end of a program.
        folder: The working folder of the process; its output is kept beside it.
        wall_s: Seconds after which the process is killed.
    """
    folder.mkdir(parents=True, exist_ok=True)
    output = folder.with_name(f"{folder.name}.out")
    start = time.monotonic()
    pid = os.fork()
    if pid == 0:
        _run_as_program(function, folder, output)
    status, usage, hung = _wait(pid, start + wall_s)
    with suppress(ProcessLookupError):  # children that it has left
        os.killpg(pid, signal.SIGKILL)
    return Ended(
        os.waitstatus_to_exitcode(status),
        output.read_bytes(),
        time.monotonic() - start,
        usage.ru_utime + usage.ru_stime,
        usage.ru_maxrss << 10,
        hung,
    )


def _wait(pid: int, end: float) -> tuple[int, resource.struct_rusage, bool]:
    hung = False
    while True:
        done, status, usage = os.wait4(pid, os.WNOHANG)
        if done:
            return status, usage, hung
        if time.monotonic() > end and not hung:
            hung = True
            with suppress(ProcessLookupError):
                os.killpg(pid, signal.SIGKILL)
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        time.sleep(_POLL_S)


def _run_as_program(function: Callable[[], None], folder: Path, output: Path) -> None:
    """Run the function as a program that ends with it; never returns."""
    code = 1
    try:
        os.setsid()
        os.chdir(folder)
        _redirect(output)
        _drop_overrides()
        space = _address_space() + _ADDRESS_SPACE
        resource.setrlimit(resource.RLIMIT_AS, (space, space))
        code = _exit_code(function)
        sys.stdout.flush()
        sys.stderr.flush()
    finally:
        os._exit(code)


def _exit_code(function: Callable[[], None]) -> int:
    try:
        function()
    except SystemExit as end:
        if isinstance(end.code, int) or end.code is None:
            return end.code or 0
        print(end.code, file=sys.stderr)  # noqa: T201
        return 1
    except BaseException:
        traceback.print_exc()
        return 1
    return 0


def _redirect(output: Path) -> None:
    null = os.open(os.devnull, os.O_RDONLY)
    file = os.open(output, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_APPEND, 0o644)
    for source, target in ((null, 0), (file, 1), (file, 2)):
        os.dup2(source, target)
    # As a new interpreter would open them: the parent's may be pytest's.
    sys.stdout = open(1, "w", encoding="utf-8", closefd=False)  # noqa: SIM115
    sys.stderr = open(  # noqa: SIM115
        2, "w", encoding="utf-8", errors="backslashreplace", closefd=False, buffering=1
    )


def _address_space() -> int:
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0])
    return pages * resource.getpagesize()


def _drop_overrides() -> None:
    """Give up root's right to read and write files whose mode forbids it."""
    libc = ctypes.CDLL(None, use_errno=True)
    header = ctypes.create_string_buffer(struct.pack("Ii", _CAPABILITY_VERSION, 0))
    data = ctypes.create_string_buffer(24)
    if libc.capget(header, data) != 0:
        raise OSError(ctypes.get_errno(), "capget failed")
    effective, permitted, inheritable, *high = struct.unpack("6I", data.raw)
    kept = (number & ~_OVERRIDES for number in (effective, permitted, inheritable))
    if libc.capset(header, ctypes.create_string_buffer(struct.pack("6I", *kept, *high))) != 0:
        raise OSError(ctypes.get_errno(), "capset failed")
