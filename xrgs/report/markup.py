"""Writes tables as Markdown and LaTeX; any character of their texts is escaped."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from xrgs.runtime.text import TextTable, one_line, padded
from xrgs.safeio.sanitize import MAX_CELL, for_file_name, for_latex, for_line, for_markdown

#: Shrinks a table that is wider than the text.
_LATEX_FITTED = r"\resizebox{\ifdim\width>\linewidth\linewidth\else\width\fi}{!}{%"
#: Packages that a document needs for the tables of `to_latex`.
_LATEX_PREAMBLE = "% The document needs \\usepackage{booktabs} and \\usepackage{graphicx}.\n"
#: Tables between two page breaks: LaTeX fails at more than 50 without text between them ("100
#: consecutive dead cycles").
_MOST_FLOATS = 25


def titled(text: str, condition: str) -> str:
    """Return a heading with its condition in brackets, if there is one."""
    return f"{text} ({condition})" if condition else text


def filled_places(rows: Sequence[tuple[str, ...]]) -> list[int]:
    """Return the indices of the columns that have a text in any row."""
    return [place for place, texts in enumerate(zip(*rows, strict=True)) if any(texts)]


def filled(table: TextTable) -> TextTable:
    """Remove the columns that are empty in every row; a table without rows stays as it is.

    The table must have no `spans` and `best`, which name columns by their index.
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


def to_markdown(table: TextTable) -> str:
    """Write a table as GitHub-flavoured Markdown with a heading; the source is aligned, too."""
    head, *body = (tuple(map(for_markdown, one_line(row))) for row in (table.heads, *table.rows))
    lines, sizes = padded([head, *_marked(body, table.best, "**{}**")], table.align)
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
    """Put the best cells, (row, column), into `form`, such as `**{}**`."""
    return [
        tuple(form.format(text) if (i, j) in best else text for j, text in enumerate(row))
        for i, row in enumerate(rows)
    ]


def to_latex(table: TextTable) -> str:
    """Write a table as LaTeX with caption and label; it needs `booktabs` and `graphicx`."""
    head, *body = (tuple(map(for_latex, one_line(row))) for row in (table.columns, *table.rows))
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


def latex_file(tables: Sequence[TextTable]) -> str:
    r"""Write tables as a file for `\input` in a LaTeX document."""
    texts = [to_latex(table) for table in tables]
    for last in range(_MOST_FLOATS - 1, len(texts) - 1, _MOST_FLOATS):
        texts[last] += "\\clearpage\n"
    return _LATEX_PREAMBLE + "\n".join(texts)


def _latex_spans(table: TextTable) -> list[str]:
    """Return the row of headings over several columns and the rules below it; [] for none."""
    if not table.spans:
        return []
    cells, rules, column = [], [], 1
    for head, columns in table.spans:
        cells.append(rf"\multicolumn{{{columns}}}{{c}}{{{for_latex(for_line(head, MAX_CELL))}}}")
        if head:
            rules.append(rf"\cmidrule(lr){{{column}-{column + columns - 1}}}")
        column += columns
    return [" & ".join(cells) + r" \\", " ".join(rules)]
