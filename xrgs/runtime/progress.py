"""How far a long piece of work is: one way to say it, whoever looks.

On a terminal it is a bar. In a log, where a bar would be a page of carriage returns, it is a line
now and then. What another process watches (`kept_in`) leaves it in a small file instead: a sweep's
cells may be on other machines, and many of them are shown in one line.
"""

from __future__ import annotations

import io
import math
import sys
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any, TypeVar

from tqdm import tqdm

from xrgs.safeio import untrusted
from xrgs.safeio.atomic import write_json

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator
    from pathlib import Path

    _Tqdm = tqdm[Any]
else:
    _Tqdm = tqdm

_T = TypeVar("_T")

#: Seconds between two states of a bar, of the file, and two lines of a log.
_BAR_S, _FILE_S, _LINE_S = 0.5, 2.0, 60.0
#: What is over sooner, s, gets no bar.
_SHORT_S = 2.0
#: Of what is read of such a file.
_MOST_BYTES = 1 << 12

_file: ContextVar[Path | None] = ContextVar("file", default=None)


@dataclass(frozen=True)
class Progress:
    """How far something is."""

    what: str
    """What is done: `training`."""
    unit: str
    """Of what, in the singular: `step`."""
    done: int
    total: int | None
    rate: float | None
    """Units a second, lately; None where it is not known yet."""

    @property
    def left_s(self) -> float | None:
        """Seconds that are left at this rate."""
        return (self.total - self.done) / self.rate if self.total and self.rate else None

    @property
    def count(self) -> str:
        """`training 1,200 of 3,000 steps`."""
        of = "" if self.total is None else f" of {self.total:,}"
        return f"{self.what} {self.done:,}{of} {self.unit}s"

    def __str__(self) -> str:
        parts = [self.count]
        if self.rate:
            parts.append(f"{self.rate:.3g} {self.unit}s/s")
        if self.left_s is not None:
            parts.append(f"{duration(self.left_s)} left")
        return ", ".join(parts)


class Bar(_Tqdm):
    """Counts items as they are taken, or what `update` is told, and shows how many there were."""

    monitor_interval = 0  # tqdm's own thread is for bars that skip looking at the clock

    def __init__(
        self,
        what: str,
        unit: str,
        total: int | None = None,
        *,
        items: Iterable[Any] | None = None,
        done: int = 0,
    ) -> None:
        """Nothing is done yet.

        Args:
            what: What is done with them.
            unit: What one of them is, in the singular.
            total: How many there are in all; that of `items` where they have a length.
            items: What is counted as it is taken; None where `update` is called.
            done: So many were behind us before; `items` are the others.
        """
        self._file = _file.get()
        self._drawn = self._file is None and sys.stderr.isatty()
        every, delay = (_BAR_S, _SHORT_S) if self._drawn else (_LINE_S, _LINE_S)
        super().__init__(
            items,
            what,
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
        """Show it where it is to be seen: tqdm calls this when it is time, and at its end."""
        if self._drawn:
            draw: Callable[..., Any] = super().display
            return draw(msg, pos)  # tqdm wants it back: whether there is something to be cleared
        if msg is None:  # else it is the end, and empty
            total = None if self.total is None else int(self.total)
            now = Progress(self.desc, self.unit, int(self.n), total, self._rate())
            if self._file is None:
                say(str(now))
            else:
                _write(self._file, now)
        return None

    def _rate(self) -> float | None:
        known = self.format_dict
        done = self.n - self.initial
        return known["rate"] or (done / known["elapsed"] if done and known["elapsed"] else None)


def progress(
    items: Iterable[_T], what: str, unit: str, total: int | None = None, *, done: int = 0
) -> Iterator[_T]:
    """The items, with a `Bar` that counts them."""
    return iter(Bar(what, unit, total, items=items, done=done))


def _write(file: Path, now: Progress) -> None:
    # No result: a file that can't be written, or is lost when the power goes, does no harm.
    with suppress(OSError):
        write_json(file, asdict(now), durable=False)


@contextmanager
def kept_in(file: Path) -> Iterator[None]:
    """Bars made within are drawn nowhere: the latest is in `file`, which is gone at the end."""
    token = _file.set(file)
    try:
        yield
    finally:
        _file.reset(token)
        with suppress(OSError):
            file.unlink(missing_ok=True)


def read(file: Path) -> Progress | None:
    """What a process left in a file; None where there is nothing, or nothing that makes sense."""
    try:
        found = untrusted.parse_json(untrusted.read_bytes(file, _MOST_BYTES))
        total, rate = found["total"], found["rate"]
        return Progress(
            str(found["what"]),
            str(found["unit"]),
            int(found["done"]),
            None if total is None else int(total),
            None if rate is None or not math.isfinite(rate) else float(rate),
        )
    except (OSError, ValueError, KeyError, TypeError, OverflowError):
        return None


def say(text: str) -> None:
    """A line on stderr for who watches; on a terminal, in place of a bar that may stand there."""
    clear = "\r\x1b[K" if sys.stderr.isatty() else ""
    print(f"{clear}{text}", file=sys.stderr, flush=True)  # noqa: T201


def duration(seconds: float | None) -> str:
    """For people: `~40 s`, `~12 min`, `~3.5 h`, `?`."""
    if seconds is None:
        return "?"
    if seconds < 99.5:
        return f"~{seconds:.0f} s"
    if seconds < 99.5 * 60:
        return f"~{seconds / 60:.0f} min"
    return f"~{seconds / 3600:.1f} h"
