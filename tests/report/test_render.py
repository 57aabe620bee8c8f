"""Tables keep their shape whatever the names hold."""

import re

from hypothesis import given
from hypothesis import strategies as st

from xrgs.report.render import (
    TextTable,
    to_latex,
    to_markdown,
    to_text,
    width,
)

TABLE = TextTable(
    title="a_b & c",
    columns=("Metric", "50% | x"),
    rows=(("PSNR", "-0.80 ↓"), ("[odd]", "n/a")),
    align="lr",
    notes=("100 $",),
)


def test_text_is_aligned() -> None:
    assert to_text(TABLE) == (
        "a_b & c\n\nMetric  50% | x\n──────  ───────\nPSNR    -0.80 ↓\n[odd]       n/a\n100 $\n"
    )


def test_markdown_is_escaped_and_aligned() -> None:
    assert to_markdown(TABLE) == (
        "### a\\_b \\& c\n"
        "\n"
        "| Metric  | 50% \\| x |\n"
        "| ------- | -------: |\n"
        "| PSNR    |  -0.80 ↓ |\n"
        "| \\[odd\\] |      n/a |\n"
        "\n"
        "- 100 \\$\n"
    )


def test_latex_is_escaped() -> None:
    text = to_latex(TABLE)
    assert r"\caption{a\_b \& c}" in text
    assert r"Metric & 50\% \textbar{} x \\" in text
    assert r"PSNR & $-$0.80 $\downarrow$ \\" in text
    assert r"{[}odd{]} & n/a \\" in text
    assert r"\begin{tabular}{lr}" in text
    assert r"100 \$" in text


def test_wide_characters_keep_the_columns() -> None:
    table = TextTable("t", ("a", "b"), (("部屋", "1"), ("cafe\u0301", "2"), ("plain", "3")), "lr")
    lines = to_text(table).splitlines()[2:]
    assert len({width(line) for line in lines}) == 1


@given(st.text(max_size=30))
def test_a_name_stays_in_its_cell(name: str) -> None:
    table = TextTable("t", ("a", "b"), ((name, "1"),), "ll")
    lines = to_markdown(table).split("\n")
    assert len(lines) == 6
    assert len(re.findall(r"(?<!\\)(?:\\\\)*\|", lines[4])) == 3
    assert len(to_text(table).split("\n")) == 6
    row = next(line for line in to_latex(table).split("\n") if line.endswith(r"1 \\"))
    assert len(re.findall(r"(?<!\\)&", row)) == 1
