"""Ends a command in order on Ctrl-C and SIGTERM, or lets its work choose when to end."""

from __future__ import annotations

import ctypes
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

from xrgs.runtime.streams import say


class StopSignal(KeyboardInterrupt):
    """Raised by the first SIGINT or SIGTERM; libraries handle it as they handle Ctrl-C."""

    def __init__(self, number: int) -> None:
        super().__init__(number)
        self.number = number


@contextmanager
def exit_on_signal(hint: str) -> Iterator[None]:
    """End this process in order when SIGINT or SIGTERM arrives during a block.

    The first signal raises an exception in the block, so that its `finally` clauses run; the second
    one ends the process at once. A signal that the process ignored from its start (`nohup`, a
    shell's `&`) stays ignored. `hint` is printed after the name of the signal: what is kept, and
    how to go on. The exit code is 128 plus its number, as shells report it.
    """
    for number in (signal.SIGINT, signal.SIGTERM):
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, _raise_stop)
    try:
        yield
    except StopSignal as stop:
        say(f"stopped by {signal.Signals(stop.number).name}. {hint}", sys.stderr)
        sys.exit(128 + stop.number)


#: Signals for which a library may install a handler that reports crashes, as COLMAP's does.
_CRASH_SIGNALS = (
    *(signal.SIGABRT, signal.SIGBUS, signal.SIGFPE, signal.SIGILL, signal.SIGSEGV),
    signal.SIGTERM,
)
#: More bytes than `struct sigaction` has on any system.
_SIGACTION_BYTES = 512


@contextmanager
def handlers_kept() -> Iterator[None]:
    """Restore, after a block, the signal handlers that a library replaces in it.

    SIGTERM is blocked meanwhile, since the library's handler would print a stack.
    """
    libc = ctypes.CDLL(None)
    before = {number: ctypes.create_string_buffer(_SIGACTION_BYTES) for number in _CRASH_SIGNALS}
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGTERM})
    for number, action in before.items():
        libc.sigaction(number, None, action)
    try:
        yield
    finally:
        for number, action in before.items():
            libc.sigaction(number, action, None)
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)


class StopRequest:
    """Turns SIGTERM into an exception that work can put off until it has kept its state."""

    def __init__(self) -> None:
        self.received = False
        """Whether the signal has arrived."""
        self._is_deferred = False

    def watch(self) -> None:
        """From now on, raise `StopSignal` at SIGTERM instead of ending this process."""
        signal.signal(signal.SIGTERM, self._on_signal)

    @contextmanager
    def deferred(self) -> Iterator[None]:
        """During a block, which reads `received` itself, raise nothing at the signal."""
        self._is_deferred = True
        try:
            yield
        finally:
            self._is_deferred = False

    def _on_signal(self, number: int, _: FrameType | None) -> None:
        self.received = True
        if not self._is_deferred:
            raise StopSignal(number)


def end_by_sigterm() -> None:
    """End this process as SIGTERM ends one that has no handler, so that its parent can tell."""
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    signal.raise_signal(signal.SIGTERM)


def _raise_stop(number: int, _: FrameType | None) -> None:
    for handled in (signal.SIGINT, signal.SIGTERM):
        if signal.getsignal(handled) is _raise_stop:
            signal.signal(handled, signal.SIG_DFL)
    raise StopSignal(number)
