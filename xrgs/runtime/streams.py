"""Writes text for people to stdout, stderr and logs: the only place of the package that prints.

It keeps the program running when its terminal is closed, when the reader of its pipe has ended, and
when it was started without streams.
"""

from __future__ import annotations

import io
import logging
import os
import shutil
import sys
from contextlib import suppress
from typing import TYPE_CHECKING

from xrgs.safeio.sanitize import for_line, for_terminal

if TYPE_CHECKING:
    from typing import Any, TextIO

    from _typeshed import ReadableBuffer


def say(text: str, stream: TextIO | None = None) -> None:
    """Print a text, on stdout by default; on a terminal it replaces a bar on the current line.

    The terminal obeys no code in the text. A character that the stream's encoding lacks is written
    as its number. In a text of several lines, names must have gone through `for_line`.
    """
    stream = sys.stdout if stream is None else stream
    encoding = stream.encoding or "utf-8"  # a stream in memory has none
    text = for_terminal(text).encode(encoding, "backslashreplace").decode(encoding)
    clear = "\r\x1b[K" if is_terminal(stream) else ""
    stream.write(f"{clear}{text}\n")  # at once: `print` could be cut by another thread's line
    stream.flush()


def redraw(text: str, above: int, terminal: TextIO) -> int:
    """Print a text on a terminal over the last lines that this function printed; return its lines.

    Names in it must have gone through `for_line`. A line is cut at the terminal's width, and lines
    that do not fit below one another are left out. `above` is the number of lines to print over, as
    the last call returned it; 0 at first.
    """
    width, height = shutil.get_terminal_size()
    lines = [line[: width - 1] for line in text.split("\n")][: height - 1]
    up = f"\x1b[{above}A" if above else ""
    body = "".join(f"{for_terminal(line)}\x1b[K\n" for line in lines)
    print(f"{up}\r{body}\x1b[J", end="", file=terminal, flush=True)
    return len(lines)


def is_terminal(stream: TextIO) -> bool:
    """Return whether a stream is a terminal that can draw over a line; TERM=dumb says it can't."""
    return stream.isatty() and os.environ.get("TERM") != "dumb"


def log_to_stderr(level: int = logging.WARNING) -> None:
    """Write log messages of at least this level to stderr, each on one line."""
    handler = logging.StreamHandler()
    handler.setFormatter(_OneLineFormatter("%(asctime)s %(message)s"))
    logging.basicConfig(handlers=[handler], level=level)


class _OneLineFormatter(logging.Formatter):
    """Formats a message as one line; only a traceback below it has several."""

    def formatMessage(self, record: logging.LogRecord) -> str:  # noqa: N802 - logging's own name
        return for_line(super().formatMessage(record))

    def formatException(self, ei: Any) -> str:  # noqa: N802 - logging's own name
        return for_terminal(super().formatException(ei))


class _WriteErrorsIgnored(io.FileIO):
    """A file descriptor that reports every write as complete, whether it succeeded or not."""

    def write(self, data: ReadableBuffer) -> int:
        """Write as much as possible, and return the size of all data."""
        with suppress(OSError):
            return super().write(data)
        return memoryview(data).nbytes


def guard_streams() -> None:
    """Give this process three standard streams, of which stdout and stderr never fail.

    A stream that was closed at the start, as a daemon starts its children, becomes /dev/null. Text
    to a closed terminal, a pipe without a reader or a full disk is lost, and the work goes on.

    Every command calls this before it opens a file: a file gets the lowest free descriptor, and
    what libraries print to a closed stdout would be written into it.
    """
    for descriptor in range(3):
        try:
            os.fstat(descriptor)
        except OSError:  # it is closed, so that the lowest free descriptor is this one
            os.set_inheritable(os.open(os.devnull, os.O_RDWR), True)
    if sys.stdin is None:
        sys.stdin = io.TextIOWrapper(io.BufferedReader(io.FileIO(0, closefd=False)))
    for descriptor, name in ((1, "stdout"), (2, "stderr")):
        stream = getattr(sys, name)
        # A stream that other code has put in the place of Python's own stays.
        if stream is getattr(sys, f"__{name}__"):
            encoding = "utf-8" if stream is None else stream.encoding
            raw = io.BufferedWriter(_WriteErrorsIgnored(descriptor, "w", closefd=False))
            # Help and bars have characters that ASCII lacks.
            text = io.TextIOWrapper(raw, encoding, "backslashreplace", line_buffering=True)
            setattr(sys, name, text)
