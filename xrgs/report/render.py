"""Writes a table of strings as aligned text, Markdown or LaTeX, whatever characters it holds."""

from __future__ import annotations

import unicodedata
from dataclasses import dataclass

from xrgs.safeio.words import MAX_CELL, for_latex, for_line, for_markdown


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


def titled(text: str, condition: str) -> str:
    """Return a heading that names the condition, where there is one.

    Args:
        text: The heading.
        condition: The condition; empty for none.
    """
    return f"{text} ({condition})" if condition else text


def width(text: str) -> int:
    """Return the terminal columns that `text` takes.

    Args:
        text: One line; East Asian wide characters take two columns, combining accents none.
    """
    wide = sum(unicodedata.east_asian_width(char) in "WF" for char in text)
    return len(text) + wide - sum(unicodedata.combining(char) > 0 for char in text)


def _pad(text: str, size: int, align: str) -> str:
    space = " " * (size - width(text))
    return space + text if align == "r" else text + space


def _padded(rows: list[tuple[str, ...]], align: str) -> tuple[list[list[str]], list[int]]:
    sizes = [max(3, *(width(text) for text in column)) for column in zip(*rows, strict=True)]
    lines = [
        [_pad(text, size, side) for text, size, side in zip(row, sizes, align, strict=True)]
        for row in rows
    ]
    return lines, sizes


def _rows(table: TextTable) -> list[tuple[str, ...]]:
    """Return the heads of the columns and the rows, in cells of one line of bounded length."""
    rows = (table.columns, *table.rows)
    return [tuple(for_line(text, MAX_CELL).strip() for text in row) for row in rows]


def to_text(table: TextTable) -> str:
    """Write the table for a terminal.

    Args:
        table: The table.

    Returns:
        Aligned lines under the title, with the notes below.
    """
    lines, sizes = _padded(_rows(table), table.align)
    lines.insert(1, ["─" * size for size in sizes])
    body = ["  ".join(line).rstrip() for line in lines]
    return "\n".join([for_line(table.title), "", *body, *map(for_line, table.notes), ""])


def to_markdown(table: TextTable) -> str:
    """Write the table as GitHub-flavoured Markdown under a heading, aligned in the source as well.

    Args:
        table: The table.
    """
    rows = [tuple(map(for_markdown, row)) for row in _rows(table)]
    lines, sizes = _padded(rows, table.align)
    rule = [
        "-" * (size - 1) + (":" if side == "r" else "-")
        for size, side in zip(sizes, table.align, strict=True)
    ]
    lines.insert(1, rule)
    body = ["| " + " | ".join(line) + " |" for line in lines]
    notes = [f"- {for_markdown(note)}" for note in table.notes]
    parts = [[f"### {for_markdown(table.title)}"], body, notes]
    return "\n\n".join("\n".join(part) for part in parts if part) + "\n"


def to_latex(table: TextTable) -> str:
    """Write the table as LaTeX of the package `booktabs`.

    Args:
        table: The table.
    """
    lines = [" & ".join(map(for_latex, row)) + r" \\" for row in _rows(table)]
    notes = [rf"\par\footnotesize {for_latex(note)}" for note in table.notes]
    return "\n".join(
        [
            r"\begin{table}[htbp]",
            r"\centering",
            rf"\caption{{{for_latex(table.title)}}}",
            rf"\begin{{tabular}}{{{table.align}}}",
            r"\toprule",
            lines[0],
            r"\midrule",
            *lines[1:],
            r"\bottomrule",
            r"\end{tabular}",
            *notes,
            r"\end{table}",
            "",
        ]
    )
