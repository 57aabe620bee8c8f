"""Shows the progress of long work: as a bar, as lines of a log, or in a file for another process.

On a terminal progress is a tqdm bar, and in a log one line a minute. Inside `written_to` it is kept
in a small file and not shown: the cells of a sweep may run on other machines, and one line of the
sweep shows them all.
"""

from __future__ import annotations

import io
import sys
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

import msgspec
from tqdm import tqdm

from xrgs.runtime.streams import is_terminal, say
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

#: Seconds between two updates: of a bar, of the file, and of a log.
_BAR_S, _FILE_S, _LINE_S = 0.5, 2.0, 60.0
#: Seconds before a bar appears, so that short work shows none.
_BAR_DELAY_S = 2.0
#: The largest progress file that is read, in bytes.
_MAX_BYTES = 1 << 12
#: The most characters that are shown of the name of a piece of work, its unit or its note.
_MAX_WORD = 80
_Count = Annotated[int, msgspec.Meta(ge=0, lt=1 << 53)]


@dataclass
class ProgressFile:
    """The file that progress is kept in while a `with` block of `written_to` runs."""

    path: Path
    note: str = ""
    """A remark on the work, shown with the next count."""


_file: ContextVar[ProgressFile | None] = ContextVar("file", default=None)


class Progress(msgspec.Struct, frozen=True):
    """How much of a piece of work is done."""

    what: str
    """The work, for example `training`."""
    unit: str
    """The counted thing, in the singular, for example `step`."""
    done: _Count
    total: _Count | None
    """How many there are in all; None if unknown."""
    rate: Annotated[float, msgspec.Meta(gt=1e-15, lt=1e15)] | None
    """Recent units per second; None if not known yet."""
    note: str = ""
    """A remark on the work, for example `84,000 Gaussians, loss 0.041`."""

    @property
    def remaining_s(self) -> float | None:
        """The estimated seconds to the end; None if total or rate are unknown."""
        return (self.total - self.done) / self.rate if self.total and self.rate else None

    @property
    def count(self) -> str:
        """A phrase such as `training 1,200 of 3,000 steps`, with the note."""
        total = "" if self.total is None else f" of {self.total:,}"
        what, unit, note = (for_line(text, _MAX_WORD) for text in (self.what, self.unit, self.note))
        return f"{what} {self.done:,}{total} {unit}s" + (note and f", {note}")

    def __str__(self) -> str:
        parts = [self.count]
        if self.rate:
            parts.append(f"{self.rate:.3g} {for_line(self.unit, _MAX_WORD)}s/s")
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
            unit: The counted thing, in the singular; `byte` is shown in kB and MB.
            total: How many there are in all; by default the length of `items`, if they have one.
            items: Items to iterate over and count; None to call `update` instead.
            done: How many were done before `items`.
        """
        self._file = _file.get()
        self._drawn = self._file is None and is_terminal(sys.stderr)
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
        """Show the count; tqdm calls this when an update is due, and with a text at the end."""
        if self._drawn:
            draw: Callable[..., Any] = super().display
            return draw(msg, pos)
        if msg is None:
            total = None if self.total is None else int(self.total)
            note = "" if self._file is None else self._file.note
            state = Progress(self.desc, self.unit, int(self.n), total, self._rate(), note)
            if self._file is None:
                log_line(str(state))
            else:
                with suppress(OSError):  # nothing is lost: progress is not a result
                    write_json(self._file.path, msgspec.structs.asdict(state), durable=False)
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
    """Iterate over items while a `ProgressBar`, which has the same arguments, counts them."""
    return iter(ProgressBar(what, unit, total, items=items, done=done))


@contextmanager
def written_to(file: Path) -> Iterator[ProgressFile]:
    """Keep the latest state of the latest bar of a block in a file, and show no bar.

    The file that is yielded has a note that can be set. It is removed at the end.
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
    """Read the progress that another process keeps in a file; None if there is no valid one."""
    try:
        return msgspec.json.decode(read_bytes(file, _MAX_BYTES), type=Progress)
    except (OSError, msgspec.DecodeError, UnicodeDecodeError):
        return None


def log_line(text: str) -> None:
    """Print a text as one line on stderr; on a terminal it replaces a bar on the current line."""
    say(for_line(text), sys.stderr)
