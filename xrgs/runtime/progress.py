"""Shows the progress of long work: as a bar, as lines of a log, or in a file for another process.

On a terminal progress is a tqdm bar. In a log, where a bar would be a page of carriage returns, it
is one line a minute. Inside `written_to` it is kept in a small file instead, and nothing is shown:
the cells of a sweep may run on other machines, and one line shows many of them.
"""

from __future__ import annotations

import io
import json
import sys
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any, TypeVar

from tqdm import tqdm

from xrgs.runtime.streams import say
from xrgs.runtime.text import format_duration
from xrgs.safeio.atomic import write_json
from xrgs.safeio.files import read_bytes
from xrgs.safeio.sanitize import for_line

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator
    from pathlib import Path

    _Tqdm = tqdm[Any]
else:
    _Tqdm = tqdm

_T = TypeVar("_T")

#: Seconds between two updates of a bar, of the file, and between two lines of a log.
_BAR_S, _FILE_S, _LINE_S = 0.5, 2.0, 60.0
#: Seconds before a bar appears, so that short work shows none.
_BAR_DELAY_S = 2.0
#: The largest progress file that is read, in bytes.
_MAX_BYTES = 1 << 12
#: The most characters of a bar's words that are shown.
_MAX_WORD = 80
#: Counts, and units a second, beyond this are not valid.
_MAX_COUNT = 1 << 53


@dataclass
class ProgressFile:
    """The file that progress is kept in while a `with` block of `written_to` runs."""

    path: Path
    note: str = ""
    """What else is to be shown of the work now; written with the next count."""


_file: ContextVar[ProgressFile | None] = ContextVar("file", default=None)


@dataclass(frozen=True)
class Progress:
    """How much of a piece of work is done."""

    what: str
    """The work, for example `training`."""
    unit: str
    """What is counted, in the singular, for example `step`."""
    done: int
    total: int | None
    """How many there are in all; None where that is not known."""
    rate: float | None
    """Recent units per second; None where that is not known yet."""
    note: str = ""
    """What else is known of the work, for example `84,000 Gaussians, loss 0.041`."""

    @property
    def remaining_s(self) -> float | None:
        """The estimated seconds to the end; None where total or rate are not known."""
        return (self.total - self.done) / self.rate if self.total and self.rate else None

    @property
    def count(self) -> str:
        """A phrase such as `training 1,200 of 3,000 steps`, with the note."""
        of = "" if self.total is None else f" of {self.total:,}"
        return f"{self.what} {self.done:,}{of} {self.unit}s" + (self.note and f", {self.note}")

    def __str__(self) -> str:
        parts = [self.count]
        if self.rate:
            parts.append(f"{self.rate:.3g} {self.unit}s/s")
        if self.remaining_s is not None:
            parts.append(f"{format_duration(self.remaining_s)} left")
        return ", ".join(parts)


class ProgressBar(_Tqdm):
    """Counts items as they are iterated over, or by `update`, and shows the count.

    It is a tqdm bar whose output goes to a terminal, a log or a file, see the module.
    """

    monitor_interval = 0  # tqdm's monitoring thread serves bars that skip updates: these do not

    def __init__(
        self,
        what: str,
        unit: str,
        total: int | None = None,
        *,
        items: Iterable[Any] | None = None,
        done: int = 0,
    ) -> None:
        """Start counting.

        Args:
            what: The work, for example `training`.
            unit: What is counted, in the singular; `byte` is shown in kB and MB.
            total: How many there are in all; by default the length of `items`, where they have one.
            items: What to iterate over and count; None where `update` is called instead.
            done: How many were done before; `items` are the others.
        """
        self._file = _file.get()
        self._drawn = self._file is None and sys.stderr.isatty()
        every, delay = (_BAR_S, _BAR_DELAY_S) if self._drawn else (_LINE_S, _LINE_S)
        super().__init__(
            items,
            for_line(what, _MAX_WORD),
            total,
            leave=False,
            file=sys.stderr if self._drawn else io.StringIO(),
            mininterval=every if self._file is None else _FILE_S,
            miniters=1,
            delay=delay if self._file is None else 0,
            unit=unit,
            unit_scale=unit == "byte",
            initial=done,
        )

    def display(self, msg: str | None = None, pos: int | None = None) -> Any:
        """Show the count; tqdm calls this when an update is due, and at the end.

        Args:
            msg: tqdm's own text: None for the count, empty at the end.
            pos: The line of the terminal, counted from the bar's own.

        Returns:
            On a terminal what tqdm returns, else None.
        """
        if self._drawn:
            draw: Callable[..., Any] = super().display
            return draw(msg, pos)
        if msg is None:
            total = None if self.total is None else int(self.total)
            note = "" if self._file is None else self._file.note
            now = Progress(self.desc, self.unit, int(self.n), total, self._rate(), note)
            if self._file is None:
                log_line(str(now))
            else:
                _write(self._file.path, now)
        return None

    def _rate(self) -> float | None:
        state = self.format_dict
        counted = self.n - self.initial
        return state["rate"] or (
            counted / state["elapsed"] if counted and state["elapsed"] else None
        )


def progress(
    items: Iterable[_T], what: str, unit: str, total: int | None = None, *, done: int = 0
) -> Iterator[_T]:
    """Iterate over items while a `ProgressBar` counts them.

    Args:
        items: What to iterate over.
        what: The work, for example `training`.
        unit: What an item is, in the singular.
        total: How many there are in all; by default the length of `items`, where they have one.
        done: How many were done before; `items` are the others.

    Returns:
        An iterator over the same items.
    """
    return iter(ProgressBar(what, unit, total, items=items, done=done))


def _write(file: Path, now: Progress) -> None:
    # Progress is no result: it does no harm that it can't be written, or is lost with the power.
    with suppress(OSError):
        write_json(file, asdict(now), durable=False)


@contextmanager
def written_to(file: Path) -> Iterator[ProgressFile]:
    """Keep the progress of all bars made within a block in a file, and show none of them.

    Args:
        file: The file; it holds the latest state of the latest bar, and is removed at the end.

    Yields:
        The file, whose note can be set.
    """
    target = ProgressFile(file)
    token = _file.set(target)
    try:
        yield target
    finally:
        _file.reset(token)
        with suppress(OSError):
            file.unlink(missing_ok=True)


def read(file: Path) -> Progress | None:
    """Read the progress that another process keeps in a file.

    Args:
        file: The file given to `written_to` there.

    Returns:
        The progress; None where there is no such file or its content is not valid.
    """
    try:
        content = json.loads(read_bytes(file, _MAX_BYTES))
        texts = (content["what"], content["unit"], content.get("note", ""))
        what, unit, note = (for_line(str(text), _MAX_WORD) for text in texts)
        done, total, rate = content["done"], content["total"], content["rate"]
        counts = (done,) if total is None else (done, total)
        if not all(type(n) is int and 0 <= n < _MAX_COUNT for n in counts):
            return None
        known = rate is not None and 1 / _MAX_COUNT < rate < _MAX_COUNT
        return Progress(what, unit, done, total, float(rate) if known else None, note)
    except (OSError, ValueError, KeyError, TypeError):
        return None


def log_line(text: str) -> None:
    """Print one line on stderr; on a terminal it replaces a bar on the current line.

    Args:
        text: The line, without its end; line breaks in it become spaces.
    """
    say(for_line(text), sys.stderr)
