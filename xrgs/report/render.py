"""Writes a table of strings as aligned text, Markdown or LaTeX, whatever characters it holds."""

from __future__ import annotations

import re
import unicodedata
from dataclasses import dataclass

from xrgs.safeio.untrusted import one_line

_MARKDOWN = str.maketrans({char: f"\\{char}" for char in "\\`*_{}[]<>#|~$&"})
_LATEX = str.maketrans(
    {char: f"\\{char}" for char in "&%$#_{}"}
    | {
        "\\": r"\textbackslash{}",
        "~": r"\textasciitilde{}",
        "^": r"\textasciicircum{}",
        "<": r"\textless{}",
        ">": r"\textgreater{}",
        "|": r"\textbar{}",
        "[": "{[}",  # bare at the start of a row it would be an argument of the row before
        "]": "{]}",
        "↑": r"$\uparrow$",
        "↓": r"$\downarrow$",
    }
)


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


def markdown(text: str) -> str:
    """Escape `text` so that Markdown shows it as it is.

    Args:
        text: Any text; line breaks and control characters become spaces.
    """
    return one_line(text).translate(_MARKDOWN)


def latex(text: str) -> str:
    """Escape `text` so that LaTeX shows it as it is; scripts other than Latin need xelatex.

    Args:
        text: Any text; the hyphen of a negative number becomes a minus sign.
    """
    return re.sub(r"(?<!\S)-(?=\d)", "$-$", one_line(text).translate(_LATEX))


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


def to_text(table: TextTable) -> str:
    """Write the table for a terminal.

    Args:
        table: The table.

    Returns:
        Aligned lines under the title, with the notes below.
    """
    rows = [tuple(map(one_line, row)) for row in (table.columns, *table.rows)]
    lines, sizes = _padded(rows, table.align)
    lines.insert(1, ["─" * size for size in sizes])
    body = ["  ".join(line).rstrip() for line in lines]
    return "\n".join([one_line(table.title), "", *body, *map(one_line, table.notes), ""])


def to_markdown(table: TextTable) -> str:
    """Write the table as GitHub-flavoured Markdown under a heading, aligned in the source as well.

    Args:
        table: The table.
    """
    rows = [tuple(map(markdown, row)) for row in (table.columns, *table.rows)]
    lines, sizes = _padded(rows, table.align)
    rule = [
        "-" * (size - 1) + (":" if side == "r" else "-")
        for size, side in zip(sizes, table.align, strict=True)
    ]
    lines.insert(1, rule)
    body = ["| " + " | ".join(line) + " |" for line in lines]
    notes = [f"- {markdown(note)}" for note in table.notes]
    parts = [[f"### {markdown(table.title)}"], body, notes]
    return "\n\n".join("\n".join(part) for part in parts if part) + "\n"


def to_latex(table: TextTable) -> str:
    """Write the table as LaTeX of the package `booktabs`.

    Args:
        table: The table.
    """
    lines = [" & ".join(map(latex, row)) + r" \\" for row in (table.columns, *table.rows)]
    notes = [rf"\par\footnotesize {latex(note)}" for note in table.notes]
    return "\n".join(
        [
            r"\begin{table}[htbp]",
            r"\centering",
            rf"\caption{{{latex(table.title)}}}",
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
