"""A table of strings as aligned text, Markdown or LaTeX, whatever characters a name holds."""

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
class Grid:
    """A titled table of plain text; every row is as long as `columns`."""

    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    align: str
    """`l` or `r`, one a column."""
    notes: tuple[str, ...] = ()
    """Lines below the table."""


def markdown(text: str) -> str:
    """`text` so that Markdown shows it as it is."""
    return one_line(text).translate(_MARKDOWN)


def latex(text: str) -> str:
    """`text` so that LaTeX shows it as it is; other scripts than Latin want xelatex.

    The hyphen of a negative number becomes a minus.
    """
    return re.sub(r"(?<!\S)-(?=\d)", "$-$", one_line(text).translate(_LATEX))


def width(text: str) -> int:
    """Terminal columns that `text` takes: East Asian wide characters take two, accents none."""
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


def to_text(grid: Grid) -> str:
    """For a terminal."""
    rows = [tuple(map(one_line, row)) for row in (grid.columns, *grid.rows)]
    lines, sizes = _padded(rows, grid.align)
    lines.insert(1, ["─" * size for size in sizes])
    body = ["  ".join(line).rstrip() for line in lines]
    return "\n".join([one_line(grid.title), "", *body, *map(one_line, grid.notes), ""])


def to_markdown(grid: Grid) -> str:
    """A GitHub-flavoured table under a heading, aligned in the source too."""
    rows = [tuple(map(markdown, row)) for row in (grid.columns, *grid.rows)]
    lines, sizes = _padded(rows, grid.align)
    rule = [
        "-" * (size - 1) + (":" if side == "r" else "-")
        for size, side in zip(sizes, grid.align, strict=True)
    ]
    lines.insert(1, rule)
    body = ["| " + " | ".join(line) + " |" for line in lines]
    notes = [f"- {markdown(note)}" for note in grid.notes]
    parts = [[f"### {markdown(grid.title)}"], body, notes]
    return "\n\n".join("\n".join(part) for part in parts if part) + "\n"


def to_latex(grid: Grid) -> str:
    """A `booktabs` table."""
    lines = [" & ".join(map(latex, row)) + r" \\" for row in (grid.columns, *grid.rows)]
    notes = [rf"\par\footnotesize {latex(note)}" for note in grid.notes]
    return "\n".join(
        [
            r"\begin{table}[htbp]",
            r"\centering",
            rf"\caption{{{latex(grid.title)}}}",
            rf"\begin{{tabular}}{{{grid.align}}}",
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
