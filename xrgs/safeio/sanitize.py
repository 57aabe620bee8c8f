"""Makes texts of other people safe to show: one function for each kind of output.

Names of scenes, labels, reasons and messages may come from a store, an archive or a server of
somebody else. They may hold codes that a terminal obeys, formulas that a spreadsheet runs, markup
that Markdown and LaTeX obey, or a megabyte of letters. Every script, accent and emoji passes.

Everything that is written for people goes through here. Files that this package reads back, such as
a cell's `scores.csv`, keep each text exactly; code that shows their content calls this module.
"""

from __future__ import annotations

import hashlib
import re

#: The longest line, and the longest text in a cell of a table or in a picture, in characters.
MAX_LINE, MAX_CELL = 4000, 300
_MAX_TERMINAL_LINE = 20_000
#: Characters that nobody sees although `str.isprintable` accepts them: fillers, joiners, and
#: selectors of variants. U+FE0E and U+FE0F, which emoji need, are not among them.
_INVISIBLE = re.compile(
    "[\u034f\u115f\u1160\u17b4\u17b5\u180b-\u180f\u3164\ufe00-\ufe0d\uffa0\U000e0100-\U000e01ef]"
)
#: The place before a character with which a spreadsheet's formula begins: at the start of a text,
#: or after a semicolon, which separates cells in many countries. Wide forms of ASCII count too.
_FORMULA = re.compile(r"(^|;\s*)(?=[=+\-@＝＋－＠])")
#: A number with its sign, as tables print it; the arrow says whether a change is an improvement.
_NUMBER = re.compile(r"[+-]?\d[\d,.]*(e[+-]?\d+)?( (%|dB))?( [↑↓=])?", re.ASCII)
_MARKDOWN = str.maketrans(
    {char: f"\\{char}" for char in "\\`*_{}[]#|~$"}
    | {"&": "&amp;", "<": "&lt;", ">": "&gt;"}
    | {"@": "@<!-- -->"}  # GitHub makes links of e-mail addresses whose characters are escaped
)
#: The mark of a list or a rule at the start of a paragraph.
_MARKDOWN_START = re.compile(r"^(\d{0,9})([-+.)])(?=[\s-]|$)")
#: The part of an address that makes GitHub show a link without brackets.
_MARKDOWN_LINK = re.compile(r":(?=//)|(?<=www)\.")
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
        "≈": r"$\approx$",
        "−": "$-$",
    }
)
#: Characters beyond those that pdflatex sets in its default font: Latin with accents that the font
#: has, and signs of the companion font. A run of others stops it.
_NOT_PDFLATEX = re.compile(
    "[^\x00-\x7f¡-ª¬-º¼-ÏÑ-Ýß-ïñ-ýÿĀ-ăĆ-ďĒ-ėĚ-ĥĨ-ĭİ-ķĹ-ľŁ-ňŌ-ťŨ-űŴ-žȘ-ț‐-‖‘’“”†‡•…€™]+"
)


def for_line(text: str, limit: int = MAX_LINE) -> str:
    """Make a text one line without control, format or invisible characters.

    A space takes the place of each character that can't be printed, line breaks among them. A text
    longer than `limit` characters ends with an ellipsis and a hash of all of it, so that texts that
    differ only at their end can still be told apart.
    """
    if len(text) > limit:
        mark = f"…{_hash(text)[:8]}"
        text = text[: limit - len(mark)] + mark
    if not text.isprintable():
        text = "".join(char if char.isprintable() else " " for char in text)
    return _INVISIBLE.sub(" ", text)


def counted(number: int, noun: str) -> str:
    """Return a number with its noun: `1 cell`, `2 cells`. The noun is given in the singular."""
    return f"{number} {noun}{'s' * (number != 1)}"


def for_terminal(text: str) -> str:
    """Make a whole text safe for a terminal or a log; its line breaks are kept.

    A name in the text may have a line break of its own: it must have gone through `for_line`.
    """
    return "\n".join(for_line(line, _MAX_TERMINAL_LINE) for line in text.split("\n"))


def for_csv(value: object) -> object:
    """Make a value safe for a cell of a table that is opened in a spreadsheet.

    A text becomes one line, with an apostrophe where a spreadsheet would read a formula; numbers
    with a sign are not formulas. Any other value is returned unchanged.
    """
    if not isinstance(value, str):
        return value
    line = for_line(value).strip()
    return line if _NUMBER.fullmatch(line) else _FORMULA.sub(r"\1'", line)


def for_markdown(text: str) -> str:
    """Escape a text into one line that GitHub's Markdown shows as it is, without links or HTML."""
    escaped = for_line(text).strip().translate(_MARKDOWN)
    return _MARKDOWN_LINK.sub(r"\\\g<0>", _MARKDOWN_START.sub(r"\1\\\2", escaped))


def for_latex(text: str) -> str:
    """Escape a text so that LaTeX shows it as it is.

    The hyphen of a negative number becomes a minus sign. pdflatex shows a character that it has no
    font for by its number, `U+90E8`; xelatex and lualatex show it.
    """
    escaped = re.sub(r"(?<!\S)-(?=\d)", "$-$", for_line(text).strip().translate(_LATEX))
    return _NOT_PDFLATEX.sub(_by_number_in_pdflatex, escaped)


def _by_number_in_pdflatex(run: re.Match[str]) -> str:
    numbers = " ".join(f"U+{ord(char):04X}" for char in run[0])
    return rf"\ifdefined\Umathchar {run[0]}\else {numbers}\fi{{}}"


def for_file_name(text: str) -> str:
    """Return a text as part of a file name that any system accepts.

    It has at most 67 ASCII characters, and different texts give different names.
    """
    plain = re.sub(r"[^A-Za-z0-9_.]+", "-", text).strip("-.")[:60]
    if text and plain == text:
        return text
    return f"{plain}-{_hash(text)[:6]}".lstrip("-")


def _hash(text: str) -> str:
    return hashlib.sha256(text.encode(errors="surrogatepass")).hexdigest()
