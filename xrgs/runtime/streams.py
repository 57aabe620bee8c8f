"""What is printed may be lost, the work is not: terminals are closed, readers of pipes go home."""

from __future__ import annotations

import io
import sys
from contextlib import suppress
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from typing import TextIO

    from _typeshed import ReadableBuffer


class _WriteErrorsIgnored(io.FileIO):
    """A file descriptor whose errors are nobody's concern."""

    def write(self, data: ReadableBuffer) -> int:
        """Write what can be written, and say that all of it was."""
        with suppress(OSError):
            return super().write(data)
        return memoryview(data).nbytes


def ignore_broken_pipe() -> None:
    """From now on, printing to a terminal or a pipe that is gone does nothing."""
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is not None and stream is getattr(sys, f"__{name}__"):  # else it is another's
            setattr(sys, name, _without_write_errors(stream))


def _without_write_errors(stream: TextIO) -> TextIO:
    raw = _WriteErrorsIgnored(stream.fileno(), "w", closefd=False)
    return io.TextIOWrapper(
        io.BufferedWriter(raw),
        encoding=stream.encoding,
        errors=stream.errors,
        line_buffering=True,
    )
