"""What is printed may be lost, the work is not: terminals are closed, readers of pipes go home."""

from __future__ import annotations

import io
import sys
from contextlib import suppress
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from typing import TextIO

    from _typeshed import ReadableBuffer


class _Deaf(io.FileIO):
    """A file descriptor whose errors are nobody's concern."""

    def write(self, data: ReadableBuffer) -> int:
        """Write what can be written, and say that all of it was."""
        with suppress(OSError):
            return super().write(data)
        return memoryview(data).nbytes


def outlive_readers() -> None:
    """From now on, printing to a terminal or a pipe that is gone does nothing."""
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is not None and stream is getattr(sys, f"__{name}__"):  # else it is another's
            setattr(sys, name, _deaf(stream))


def _deaf(stream: TextIO) -> TextIO:
    raw = _Deaf(stream.fileno(), "w", closefd=False)
    return io.TextIOWrapper(
        io.BufferedWriter(raw),
        encoding=stream.encoding,
        errors=stream.errors,
        line_buffering=True,
    )
