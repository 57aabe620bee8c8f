"""Writes a table of strings as aligned text, Markdown or LaTeX, whatever characters it holds."""

from __future__ import annotations

import unicodedata
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from xrgs.safeio.sanitize import MAX_CELL, for_file_name, for_latex, for_line, for_markdown

if TYPE_CHECKING:
    from collections.abc import Sequence


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
    """What the table has to be read with, below its title."""
    name: str = ""
    """What LaTeX's label is made of; the title where it is empty."""
    spans: tuple[tuple[str, int], ...] = ()
    """Headings over the columns, from the left, with how many each is over; empty for none."""
    best: frozenset[tuple[int, int]] = frozenset()
    """Row and column of the cells that are printed bold, where that can be done."""


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


def filled_places(rows: Sequence[tuple[str, ...]]) -> list[int]:
    """Return the places of the columns that have a text in any row.

    Args:
        rows: The rows of a table, each as long as the others.
    """
    return [place for place, texts in enumerate(zip(*rows, strict=True)) if any(texts)]


def filled(table: TextTable) -> TextTable:
    """Return a table without the columns that are empty in every row; as it is without rows.

    Args:
        table: The table, without `spans` and `best`, which name columns by their place.
    """
    if not table.rows:
        return table
    kept = filled_places(table.rows)
    return replace(
        table,
        columns=tuple(table.columns[place] for place in kept),
        rows=tuple(tuple(row[place] for place in kept) for row in table.rows),
        align="".join(table.align[place] for place in kept),
    )


def heads(table: TextTable) -> tuple[str, ...]:
    """Return the heads of the columns, each after the heading over it.

    Args:
        table: The table.
    """
    if not table.spans:
        return table.columns
    above = [head for head, columns in table.spans for _ in range(columns)]
    return tuple(f"{head} {own}".strip() for head, own in zip(above, table.columns, strict=True))


def _rows(table: TextTable) -> list[tuple[str, ...]]:
    """Return the heads of the columns and the rows, in cells of one line of bounded length."""
    return [_cells(row) for row in (heads(table), *table.rows)]


def _cells(row: tuple[str, ...]) -> tuple[str, ...]:
    return tuple(for_line(text, MAX_CELL).strip() for text in row)


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
    head = [for_line(text) for text in (table.title, table.context) if text]
    return "\n".join([*head, "", *body, *map(for_line, table.notes), ""])


def to_markdown(table: TextTable) -> str:
    """Write the table as GitHub-flavoured Markdown under a heading, aligned in the source as well.

    Args:
        table: The table.
    """
    head, *body = (tuple(map(for_markdown, row)) for row in _rows(table))
    rows = [head, *_marked(body, table.best, "**{}**")]
    lines, sizes = _padded(rows, table.align)
    rule = [
        "-" * (size - 1) + (":" if side == "r" else "-")
        for size, side in zip(sizes, table.align, strict=True)
    ]
    lines.insert(1, rule)
    body_lines = ["| " + " | ".join(line) + " |" for line in lines]
    notes = [f"- {for_markdown(note)}" for note in table.notes]
    context = [for_markdown(table.context)] if table.context else []
    parts = [[f"### {for_markdown(table.title)}"], context, body_lines, notes]
    return "\n\n".join("\n".join(part) for part in parts if part) + "\n"


def _marked(
    rows: list[tuple[str, ...]], best: frozenset[tuple[int, int]], form: str
) -> list[tuple[str, ...]]:
    """Return the rows with `form` around the cells that are best."""
    return [
        tuple(form.format(text) if (i, j) in best else text for j, text in enumerate(row))
        for i, row in enumerate(rows)
    ]


#: Shrinks a table that is wider than the text.
_LATEX_FITTED = r"\resizebox{\ifdim\width>\linewidth\linewidth\else\width\fi}{!}{%"
#: What a document needs for the tables of `to_latex`.
LATEX_PREAMBLE = "% The document needs \\usepackage{booktabs} and \\usepackage{graphicx}.\n"


def to_latex(table: TextTable) -> str:
    """Write the table as LaTeX of the packages `booktabs` and `graphicx`, with caption and label.

    Args:
        table: The table.
    """
    head, *body = (tuple(map(for_latex, _cells(row))) for row in (table.columns, *table.rows))
    lines = [" & ".join(row) + r" \\" for row in _marked(body, table.best, r"\textbf{{{}}}")]
    notes = [rf"\par\footnotesize {for_latex(note)}" for note in table.notes]
    caption = ". ".join(for_latex(text) for text in (table.title, table.context) if text)
    return "\n".join(
        [
            r"\begin{table}[htbp]",
            r"\centering",
            rf"\caption{{{caption}}}",
            rf"\label{{tab:{for_file_name(table.name or table.title)}}}",
            _LATEX_FITTED,
            rf"\begin{{tabular}}{{{table.align}}}",
            r"\toprule",
            *_latex_spans(table),
            " & ".join(head) + r" \\",
            r"\midrule",
            *lines,
            r"\bottomrule",
            r"\end{tabular}}",
            *notes,
            r"\end{table}",
            "",
        ]
    )


def _latex_spans(table: TextTable) -> list[str]:
    """Return the row of headings over the columns, and the rules below them; nothing for none."""
    if not table.spans:
        return []
    cells, rules, column = [], [], 1
    for head, columns in table.spans:
        cells.append(rf"\multicolumn{{{columns}}}{{c}}{{{for_latex(for_line(head, MAX_CELL))}}}")
        if head:
            rules.append(rf"\cmidrule(lr){{{column}-{column + columns - 1}}}")
        column += columns
    return [" & ".join(cells) + r" \\", " ".join(rules)]
