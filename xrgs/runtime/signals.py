"""Ctrl-C and SIGTERM: what runs is ended in order, with a line that says how to go on."""

from __future__ import annotations

import signal
import sys
from contextlib import contextmanager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterator
    from types import FrameType


class Stopped(KeyboardInterrupt):
    """A signal asked this process to end; libraries treat it as they do Ctrl-C."""

    def __init__(self, number: int) -> None:
        super().__init__(number)
        self.number = number


@contextmanager
def stoppable(going_on: str) -> Iterator[None]:
    """End in order on SIGINT or SIGTERM; the second one ends this process at once.

    A signal that was ignored from the start (`nohup`, a shell's `&`) stays so.

    Args:
        going_on: what is left to say then.

    Raises:
        SystemExit: with 128 and the signal's number, as shells tell of it.
    """
    for number in (signal.SIGINT, signal.SIGTERM):
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, _stop)
    try:
        yield
    except Stopped as stopped:
        print(f"stopped by {signal.Signals(stopped.number).name}. {going_on}", file=sys.stderr)  # noqa: T201
        sys.exit(128 + stopped.number)


def _stop(number: int, _: FrameType | None) -> None:
    for each in (signal.SIGINT, signal.SIGTERM):
        if signal.getsignal(each) is _stop:
            signal.signal(each, signal.SIG_DFL)
    raise Stopped(number)
