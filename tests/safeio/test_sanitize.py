"""Texts of others are shown and obeyed by no output; programs that show them are the judges."""

from __future__ import annotations

import ast
import csv
import io
import re
import unicodedata
from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path

import cmarkgfm
import pyte
from hypothesis import example, given
from hypothesis import strategies as st

import xrgs
from xrgs.safeio import sanitize

PACKAGE = Path(xrgs.__file__).parent
EVIL = (
    "<script>alert(1)</script>\x1b[2J\x1b]0;pwned\x07\n\n# H1 | a | [x](javascript:alert(1)) "
    "![i](http://127.0.0.1/x.png) https://evil.example www.evil.example mail@evil.example "
    "\\input{/etc/passwd} $\\frac{$ \u202eabc @{u} &lt; `c` *b* _i_ ~~s~~"
)
#: Texts of characters that mean something to some output, and of any others.
TEXTS = (
    st.text(
        alphabet="ab1 \\`*_{}[]()<>#+-.!|~$&@:;/=^%\"'\n\t\r\x1b\x9b\u202e\u200b\u2028", max_size=40
    )
    | st.text(max_size=40)
    | st.text(alphabet=st.characters(categories=["Cc", "Cf", "Cs", "Zl", "Zp", "L"]), max_size=40)
    | st.sampled_from(["https://a.example", "www.a.example", "a@b.example", "1. x", "- x", "---"])
)
SCRIPTS = ["部屋", "غرفة", "חדר", "कमरा", "cafe\u0301 é", "🙂 ❤️ 🇩🇪", "ﬁ ß Ǆ", "a  b", "~/x (1)"]


def spaced(text: str) -> str:
    """The text as HTML shows it: runs of white space are one space."""
    return " ".join(text.split())


def test_every_script_passes_unchanged() -> None:
    for text in SCRIPTS:
        for way in (sanitize.for_line, sanitize.for_terminal, sanitize.for_csv):
            assert way(text) == text


@given(st.text(max_size=200))
def test_a_line_has_no_character_that_is_obeyed_or_hidden(text: str) -> None:
    line = sanitize.for_line(text)
    assert len(line) == len(text)
    for char, found in zip(text, line, strict=True):
        hidden = unicodedata.category(char) in {"Cc", "Cf", "Cs", "Zl", "Zp"}
        assert found == " " if hidden else found in {char, " "}


HIDDEN = (
    "\x00\x07\t\n\r\x1b\x7f\x85\x9b\xad\u061c\u115f\u180e\u200b\u200d\u200f\u2028\u202a\u202e"
    "\u2066\u2069\u3164\ufeff\ufff9\ud800\U000e0041\U000e0100"
)


def test_a_character_that_changes_or_hides_the_text_is_a_space() -> None:
    for char in HIDDEN:
        assert sanitize.for_line(f"a{char}b") == "a b"
        assert sanitize.for_csv(f"a{char}b") == "a b"
        assert sanitize.for_terminal(f"a{char}b") == ("a\nb" if char == "\n" else "a b")


@given(st.lists(TEXTS, min_size=1, max_size=4))
@example([EVIL, "\x1b[1;1Hover", "\x1b[?1049h", "\x1b(0q", "\x9b2J", "\x1b]0;t\x07"])
def test_a_terminal_shows_the_lines_one_below_the_other_and_does_nothing(lines: list[str]) -> None:
    safe = [sanitize.for_line(line) for line in lines]
    shown = sanitize.for_terminal("\n".join(safe))
    rows, screen = shown.split("\n"), pyte.Screen(400, 8)
    title = screen.title
    screen.set_mode(pyte.modes.LNM)  # a line feed also returns the carriage, as on a terminal
    pyte.Stream(screen).feed(shown)
    assert len(rows) == len(lines)
    assert (screen.title, screen.cursor.y, screen.cursor.attrs.fg) == (
        title,
        len(rows) - 1,
        "default",
    )
    plain = re.compile("[ -~]*")
    for row, found in zip(rows, screen.display, strict=False):
        if plain.fullmatch(row):  # of other rows the emulator joins accents and widens letters
            assert found.rstrip() == row.rstrip()


def test_a_long_text_is_shortened_and_still_distinct() -> None:
    texts = ["x" * 1_000_000 + end for end in ("", "a", "b", "ab")]
    for limit in (sanitize.MAX_CELL, sanitize.MAX_LINE):
        found = [sanitize.for_line(text, limit) for text in texts]
        assert [len(text) for text in found] == [limit] * 4
        assert len(set(found)) == 4
        assert found == [sanitize.for_line(text, limit) for text in texts]
        assert sanitize.for_line("y" * limit, limit) == "y" * limit
        assert sanitize.for_line("y" * (limit + 1), limit).startswith("y" * (limit - 9) + "…")
    for target in (
        sanitize.for_terminal,
        sanitize.for_markdown,
        sanitize.for_latex,
        sanitize.for_csv,
    ):
        assert len(str(target(texts[0]))) < 25_000
    assert sanitize.for_line(sanitize.for_line(texts[0])) == sanitize.for_line(texts[0])


def runs_a_formula(cell: str) -> bool:
    """LibreOffice's and Excel's rule: what begins so, and is not a number, is a formula."""
    start = unicodedata.normalize("NFKC", cell.lstrip())[:1]
    if start not in {"=", "+", "-", "@"} or not start:
        return False
    try:
        float(cell.replace(",", "").removesuffix(" ↑").removesuffix(" ↓").removesuffix(" ="))
    except ValueError:
        return True
    return False


@given(st.lists(TEXTS | TEXTS.map("=".__add__) | TEXTS.map("a;+".__add__), min_size=1, max_size=4))
@example(["=cmd|' /C calc'!A0", "@SUM(1)", "-2+3", "＝1", "\t=1", "\r=1", " =1", "a;=1", '"=1'])
def test_a_spreadsheet_reads_texts_and_no_formula(cells: list[str]) -> None:
    stream = io.StringIO()
    csv.writer(stream, lineterminator="\n").writerow([sanitize.for_csv(cell) for cell in cells])
    content = stream.getvalue()
    for separator in ",;\t":
        for row in csv.reader(io.StringIO(content, newline=""), delimiter=separator):
            assert not any(runs_a_formula(cell) for cell in row if separator != "\t")
    (row,) = csv.reader(io.StringIO(content, newline=""))
    for cell, found in zip(cells, row, strict=True):
        assert found.replace("'", "") == sanitize.for_line(cell).strip().replace("'", "")


def test_numbers_and_other_texts_stay() -> None:
    for cell in ("-1", "+0.80 ↑", "-44.57 ↓", "-1e-05", "1,000", "", "a=b", -1.5, None, True):
        assert sanitize.for_csv(cell) == cell


def html(markdown: str) -> str:
    """The HTML that GitHub's own parser makes, with the elements that it would leave out."""
    unsafe = cmarkgfm.cmark.Options.CMARK_OPT_UNSAFE
    return str(cmarkgfm.github_flavored_markdown_to_html(markdown, unsafe))


class Shown(HTMLParser):
    """The text and the elements of a page; an entity is the character that it stands for."""

    def __init__(self, page: str) -> None:
        super().__init__(convert_charrefs=True)
        self.text, self.tags = "", list[str]()
        self.feed(page)
        self.close()

    def handle_starttag(self, tag: str, _: object) -> None:
        self.tags.append(tag)

    def handle_data(self, data: str) -> None:
        self.text += data


@given(TEXTS)
@example(EVIL)
@example("http://a.example https://a.example ftp://a.example WWW.a.example mailto:a@b.example")
def test_markdown_shows_the_text_without_links_images_or_html(text: str) -> None:
    escaped = sanitize.for_markdown(text)
    page = Shown(html(escaped))
    # Other parsers read mathematics, and links and HTML in other ways: no bare character begins it.
    assert not set("$[<`") & set(re.sub(r"\\.", "", escaped).replace("@<!-- -->", "@"))
    assert spaced(page.text) == spaced(sanitize.for_line(text))
    assert set(page.tags) <= {"p"}


@given(TEXTS)
@example(EVIL)
def test_markdown_stays_in_a_cell_a_heading_and_a_list(text: str) -> None:
    name = sanitize.for_markdown(text)
    source = f"### {name}\n\n| a | b |\n| - | - |\n| {name} | 1 |\n\n- {name}\n\n**x {name} x**\n"
    page = Shown(html(source))
    cells = ["table", "thead", "tr", "th", "th", "tbody", "tr", "td", "td"]
    assert page.tags == ["h3", *cells, "ul", "li", "p", "strong"]
    line = sanitize.for_line(text)
    assert spaced(page.text) == spaced(f"{line} a b {line} 1 {line} x {line} x")


#: What our escapes write, and what LaTeX shows for it.
_LATEX = {
    r"\textbackslash{}": "\\",
    r"\textasciitilde{}": "~",
    r"\textasciicircum{}": "^",
    r"\textless{}": "<",
    r"\textgreater{}": ">",
    r"\textbar{}": "|",
    r"$\uparrow$": "↑",
    r"$\downarrow$": "↓",
    r"$\approx$": "≈",
    "$-$": "-",
    "{[}": "[",
    "{]}": "]",
} | {f"\\{char}": char for char in "&%$#_{}"}
_TOKEN = re.compile("|".join(map(re.escape, sorted(_LATEX, key=len, reverse=True))))


@given(TEXTS)
@example(EVIL)
def test_latex_shows_the_text_and_no_character_is_active(text: str) -> None:
    escaped = sanitize.for_latex(text)
    foreign = r"\\ifdefined\\Umathchar (.+?)\\else ([U+0-9A-F ]+)\\fi\{\}"
    for shown, numbers in re.findall(foreign, escaped):
        assert [chr(int(number[2:], 16)) for number in numbers.split()] == [*shown]
    escaped = re.sub(foreign, r"\1", escaped)
    assert not set("\\{}$&#_%~^<>|[]\n\r") & set(_TOKEN.sub("", escaped))
    shown = _TOKEN.sub(lambda found: _LATEX[found[0]], escaped)
    assert shown == sanitize.for_line(text).strip().replace("−", "-")


@given(TEXTS)
@example("../../etc/passwd")
@example("部屋")
@example("..")
@example("x" * 300)
def test_a_file_name_is_plain(text: str) -> None:
    found = sanitize.for_file_name(text)
    assert re.fullmatch(r"[A-Za-z0-9_-][A-Za-z0-9_.-]*", found)
    assert len(found) <= 67
    assert "--" not in found  # it separates the names in the name of a picture


def test_different_names_have_different_files() -> None:
    texts = ("a b", "a/b", "a-b", "a|b", "a--b", "x" * 61, "x" * 62, "\ud800", "")
    assert len({sanitize.for_file_name(text) for text in texts}) == len(texts)
    assert sanitize.for_file_name("loss_weighting") == "loss_weighting"


#: Calls that print or write a text, and the modules that may make them.
DOORS = {
    "print": {"runtime/streams"},
    "sys.stdout.write": {"bench/against_worker"},  # JSON for the parent process
    "sys.stderr.write": set(),
    "traceback.print_exc": set(),
    "traceback.print_exception": set(),
    "logging.basicConfig": {"runtime/streams"},
    "logging.StreamHandler": {"runtime/streams"},
    "warnings.warn": {"__init__"},  # sentences of our own
    "csv.writer": set(),
    "csv.DictWriter": {"safeio/records"},
    "*.to_csv": {"report/html/document", "report/page"},
    "*.to_html": set(),
    "*.to_string": set(),
}


def dotted(node: ast.expr) -> str:
    """The dotted name of an expression; what is no name in it is a question mark."""
    if isinstance(node, ast.Attribute):
        return f"{dotted(node.value)}.{node.attr}"
    return node.id if isinstance(node, ast.Name) else "?"


def calls(names: str) -> Iterator[tuple[str, str, ast.Call]]:
    """Calls of the package: the module, the dotted name of what it calls, and its node.

    Only of modules whose text has one of these words, divided by bars: parsing all takes seconds.
    """
    for path in PACKAGE.rglob("*.py"):
        text = path.read_text(encoding="utf-8")
        if re.search(names, text):
            module = path.relative_to(PACKAGE).with_suffix("").as_posix()
            nodes = ast.walk(ast.parse(text))
            yield from ((module, dotted(n.func), n) for n in nodes if isinstance(n, ast.Call))


def test_only_these_modules_print_or_write_a_text() -> None:
    found: dict[str, set[str]] = {call: set() for call in DOORS}
    for module, name, _ in calls("|".join(rf"\b{call.rpartition('.')[2]}\b" for call in DOORS)):
        for call in DOORS.keys() & {name, f"*.{name.rpartition('.')[2]}"}:
            found[call].add(module)
    assert found == DOORS


def test_a_command_ends_with_a_safe_message() -> None:
    """What `sys.exit` and Hydra's exception are given, they print."""
    for module, name, node in calls(r"sys\.exit|SystemExit|CompactHydraException"):
        if name in {"sys.exit", "SystemExit", "CompactHydraException"} and node.args:
            message = ast.unparse(node.args[0])
            safe = isinstance(node.args[0], ast.Constant) or message.startswith("for_line(")
            assert safe or re.match(r"\d|os\.EX_|_WRONG_USAGE$", message), f"{module}: {message}"
