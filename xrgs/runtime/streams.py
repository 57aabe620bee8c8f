"""Keeps the program running when its terminal is closed or the reader of its pipe has ended."""

from __future__ import annotations

import io
import sys
from contextlib import suppress
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from typing import TextIO

    from _typeshed import ReadableBuffer


class _WriteErrorsIgnored(io.FileIO):
    """A file descriptor that reports every write as complete, whether it succeeded or not."""

    def write(self, data: ReadableBuffer) -> int:
        """Write what can be written, and return the size of all of it."""
        with suppress(OSError):
            return super().write(data)
        return memoryview(data).nbytes


def ignore_broken_pipe() -> None:
    """Make stdout and stderr ignore write errors from now on.

    What is printed to a closed terminal, a pipe without a reader or a full disk is lost, and the
    work goes on. A stream that something else has put in the place of Python's own is left alone.
    """
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is not None and stream is getattr(sys, f"__{name}__"):
            setattr(sys, name, _without_write_errors(stream))


def _without_write_errors(stream: TextIO) -> TextIO:
    raw = _WriteErrorsIgnored(stream.fileno(), "w", closefd=False)
    return io.TextIOWrapper(
        io.BufferedWriter(raw),
        encoding=stream.encoding,
        errors=stream.errors,
        line_buffering=True,
    )
