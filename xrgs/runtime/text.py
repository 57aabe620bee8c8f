"""Text for people: sizes, ages and durations with their units, and aligned tables."""

from __future__ import annotations

import unicodedata
from collections.abc import Sequence
from dataclasses import dataclass
from textwrap import wrap

from xrgs.safeio.sanitize import MAX_CELL, for_line

#: The longest line of a table of sentences on a terminal, in columns.
_MAX_WIDTH = 100


def format_size(count: float | None) -> str:
    """Write a number of bytes: `12 MB`, `1.2 GB`, or `unknown` for None."""
    if count is None:
        return "unknown"
    for unit in ("B", "kB", "MB"):
        if count < 999.5:
            return f"{count:.0f} {unit}"
        count /= 1000
    return f"{count:.1f} GB"


def format_age(seconds: float | None) -> str:
    """Write an age: `40 s`, `12 min`, `3 h`, `5 d`, or `?` for None."""
    if seconds is None:
        return "?"
    for unit, length in (("d", 86400.0), ("h", 3600.0), ("min", 60.0)):
        if seconds >= length:
            return f"{seconds / length:.0f} {unit}"
    return f"{seconds:.0f} s"


def format_duration(seconds: float | None) -> str:
    """Write an expected duration: `~40 s`, `~12 min`, `~3.5 h`, or `?` for None."""
    if seconds is None:
        return "?"
    if seconds < 99.5:
        return f"~{seconds:.0f} s"
    if seconds < 99.5 * 60:
        return f"~{seconds / 60:.0f} min"
    return f"~{seconds / 3600:.1f} h"


def listed(names: Sequence[str], most: int = 6) -> str:
    """Write names for a sentence: `a, b, c`, or the first `most` of them, then `and 12 more`."""
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + more


@dataclass(frozen=True)
class TextTable:
    """A titled table of plain text, in which every row is as long as `columns`."""

    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    align: str
    """`l` or `r` for each column."""
    notes: tuple[str, ...] = ()
    """Lines below the table."""
    context: str = ""
    """Subtitle: steps, sizes, machine."""
    name: str = ""
    """The text of LaTeX's label; the title where it is empty."""
    spans: tuple[tuple[str, int], ...] = ()
    """Headings over groups of columns, from the left, each with its number of columns."""
    best: frozenset[tuple[int, int]] = frozenset()
    """Row and column of the cells that Markdown and LaTeX print bold."""
    prose: bool = False
    """Whether the last column has sentences, which a terminal and the page wrap."""

    @property
    def heads(self) -> tuple[str, ...]:
        """The heads of the columns, each after the heading of its group."""
        if not self.spans:
            return self.columns
        above = [head for head, columns in self.spans for _ in range(columns)]
        pairs = zip(above, self.columns, strict=True)
        return tuple(f"{heading} {column}".strip() for heading, column in pairs)


def to_text(table: TextTable) -> str:
    """Write a table for a terminal: aligned lines under the title, with the notes below."""
    rows = [one_line(row) for row in (table.heads, *table.rows)]
    if table.prose:
        rows = _wrapped(rows)
    lines, sizes = padded(rows, table.align)
    lines.insert(1, ["─" * size for size in sizes])
    body = ["  ".join(line).rstrip() for line in lines]
    head = [for_line(text) for text in (table.title, table.context) if text]
    return "\n".join([*head, "", *body, *map(for_line, table.notes), ""])


def _wrapped(rows: Sequence[tuple[str, ...]]) -> list[tuple[str, ...]]:
    """Wrap the last text of each row into rows below it, so that no line is too long."""
    *columns, _ = zip(*rows, strict=True)
    room = _MAX_WIDTH - sum(max(3, *map(width, column)) + 2 for column in columns)
    wrapped = []
    for *others, text in rows:
        first, *more = wrap(text, room) or [""]
        wrapped.append((*others, first))
        wrapped += [(*[""] * len(others), line) for line in more]
    return wrapped


def one_line(row: Sequence[str]) -> tuple[str, ...]:
    """Return the cells of a row as printable lines of bounded length."""
    return tuple(for_line(text, MAX_CELL).strip() for text in row)


def padded(rows: Sequence[tuple[str, ...]], align: str) -> tuple[list[list[str]], list[int]]:
    """Pad the cells of rows to the widths of their columns, and return the widths as well."""
    sizes = [max(3, *(width(text) for text in column)) for column in zip(*rows, strict=True)]
    lines = [
        [_pad(text, size, side) for text, size, side in zip(row, sizes, align, strict=True)]
        for row in rows
    ]
    return lines, sizes


def width(text: str) -> int:
    """Return the terminal columns of a line: East Asian wide characters take two, accents none."""
    wide = sum(unicodedata.east_asian_width(char) in "WF" for char in text)
    return len(text) + wide - sum(unicodedata.combining(char) > 0 for char in text)


def _pad(text: str, size: int, align: str) -> str:
    space = " " * (size - width(text))
    return space + text if align == "r" else text + space
