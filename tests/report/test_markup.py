"""Tables keep their shape whatever the names hold."""

import re
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests import pdflatex
from xrgs.report.markup import latex_file, to_latex, to_markdown
from xrgs.runtime.text import TextTable, to_text

TABLE = TextTable(
    title="a_b & c",
    columns=("Metric", "50% | x"),
    rows=(("PSNR", "-0.80 ↓"), ("[odd]", "n/a")),
    align="lr",
    notes=("100 $",),
)


def test_markdown_is_escaped_and_aligned() -> None:
    assert to_markdown(TABLE) == (
        "### a\\_b &amp; c\n"
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


SPANNED = TextTable(
    title="Scores",
    columns=("Method", "PSNR ↑", "SSIM ↑"),
    rows=(("a_b", "20.00", "0.800"), ("部屋", "21.00", "0.700")),
    align="lrr",
    context="3 steps & 2 views",
    name="scores x",
    spans=(("", 1), ("fern_1", 2)),
    best=frozenset({(1, 1), (0, 2)}),
)


def test_context_and_headings_over_columns_are_in_every_form() -> None:
    text = to_text(SPANNED).splitlines()
    assert text[:2] == ["Scores", "3 steps & 2 views"]
    assert text[3].split() == ["Method", "fern_1", "PSNR", "↑", "fern_1", "SSIM", "↑"]
    page = to_markdown(SPANNED)
    assert "3 steps &amp; 2 views\n" in page
    assert "**21.00**" in page
    assert "**20.00**" not in page


def test_latex_has_a_caption_a_label_and_headings_over_columns() -> None:
    text = to_latex(SPANNED)
    assert r"\caption{Scores. 3 steps \& 2 views}" in text
    assert r"\label{tab:scores-x-" in text
    assert r"\multicolumn{1}{c}{} & \multicolumn{2}{c}{fern\_1} \\" in text
    assert r"\cmidrule(lr){2-3}" in text
    assert r"Method & PSNR $\uparrow$ & SSIM $\uparrow$ \\" in text
    assert r"a\_b & 20.00 & \textbf{0.800} \\" in text
    assert text.index(r"\caption") < text.index(r"\label") < text.index(r"\begin{tabular}")


#: What reports write, letters that pdflatex's default font has and lacks, and other scripts.
SIGNS = (
    "↑ ↓ = ≈ × ² ⁴ … − – ° µ ±",
    "Łódź Åré Œuvre ß ñ",
    "þing Ðoð «ħ»",
    "部屋 комната غرفة α 😀 é",
)


@pytest.mark.slow
@pytest.mark.skipif(pdflatex.PDFLATEX is None, reason="there is no pdflatex")
def test_latex_compiles(tmp_path: Path) -> None:
    wide = TextTable("Wide", tuple("abcdefghij"), (("-0.80 ↓", *"123456789"),), "r" * 10)
    names = tuple((sign, "[1] ~^%", *sign[:1]) for sign in SIGNS)
    best = frozenset((row, 0) for row in range(len(SIGNS)))
    spans = ((SIGNS[-1], 2), (SIGNS[0], 1))
    signs = TextTable(SIGNS[-1], SIGNS[1:], names, "lll", SIGNS, SIGNS[0], spans=spans, best=best)
    tables = [latex_file((TABLE, SPANNED, wide, signs)), latex_file([TABLE] * 120)]
    assert not pdflatex.errors_of(tables, tmp_path)
    assert "Undefined control sequence" in pdflatex.errors_of([*tables, r"\odd"], tmp_path)


@given(st.text(st.characters(exclude_categories=["Cs"]), max_size=30))
def test_a_name_stays_in_its_cell(name: str) -> None:
    table = TextTable("t", ("a", "b"), ((name, "1"),), "ll")
    lines = to_markdown(table).split("\n")
    assert len(lines) == 6
    assert len(re.findall(r"(?<!\\)(?:\\\\)*\|", lines[4])) == 3
    assert len(to_text(table).split("\n")) == 6
    row = next(line for line in to_latex(table).split("\n") if line.endswith(r"1 \\"))
    assert len(re.findall(r"(?<!\\)&", row)) == 1
