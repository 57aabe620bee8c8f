"""JSON files and CSV tables of a store, damaged ones too."""

from __future__ import annotations

import errno
import math
import os
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec import Meta, Struct

from xrgs.errors import StoreError, UnreadableError, XrgsError
from xrgs.safeio.records import (
    as_number,
    errors_named,
    read_struct,
    read_table,
    table_text,
)


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return tmp_path / "file"


class Cell(Struct):
    """A file of a store."""

    seed: Annotated[int, Meta(ge=0)]
    views: tuple[str, ...] = ()


def test_a_struct_is_read(file: Path) -> None:
    file.write_text('{"seed": 3, "views": ["部屋"], "of a later version": {}}')
    assert read_struct(file, Cell) == Cell(3, ("部屋",))
    assert issubclass(StoreError, XrgsError)


@pytest.mark.parametrize(
    ("content", "what"),
    [
        ('{"seed": 3', "not valid JSON"),
        ("[" * 100_000 + "]" * 100_000, "the file: Expected `object`, got `array`"),
        ('{"seed":' + "[" * 100_000, "seed: Expected `int`, got `array`"),
        ('{"seed": "\\ud800"}', "not valid JSON"),
        ("{}", "the file: Object missing required field `seed`"),
        ('{"seed": -1}', "seed: Expected `int` >= 0"),
        ('{"seed": "3"}', "seed: Expected `int`, got `str`"),
        ('{"seed": 1e400}', "seed: Number out of range"),
        ('{"seed": 3, "views": [null]}', r"views\[0\]: Expected `str`, got `null`"),
    ],
)
def test_a_damaged_struct_is_named_with_its_field(file: Path, content: str, what: str) -> None:
    file.write_text(content)
    with pytest.raises(StoreError, match=f"^damaged: {file}: {what}"):
        read_struct(file, Cell)
    file.unlink()
    with pytest.raises(StoreError, match=f"{file}: No such file"):
        read_struct(file, Cell)


def test_a_table_is_header_and_rows(file: Path) -> None:
    file.write_text('name,score\n"a, b",1.5\nc,\n')
    assert read_table(file) == (["name", "score"], [["a, b", "1.5"], ["c", ""]])
    file.write_text("name,score\n")
    assert read_table(file) == (["name", "score"], [])


@pytest.mark.parametrize("text", ["", "a,a\n1,2\n", "a,b\n1\n", "a,b\n1,2,3\n", 'a,b\n1,"2\n'])
def test_a_table_whose_rows_do_not_fit_is_refused_by_name(file: Path, text: str) -> None:
    file.write_text(text)
    with pytest.raises(StoreError, match=f"{file}: "):
        read_table(file)


def test_numbers_are_read_and_anything_else_refused() -> None:
    for value in (1, 1.5, "1e3", "inf", "-inf", "1e400", 1e30, "-1e30"):
        assert as_number(value) == float(value)
    assert math.isnan(as_number(None))
    assert math.isnan(as_number(""))
    wrong: object
    for wrong in (True, [], {}, "x", 10**400, 1.1e30, "-1.1e30"):
        with pytest.raises(ValueError):  # noqa: PT011 - float's own messages
            as_number(wrong)


@given(
    st.lists(
        st.lists(st.text(st.characters(exclude_categories=["Cc", "Cs"])), min_size=2, max_size=2)
    )
)
def test_a_table_is_read_back_exactly(rows: list[list[str]]) -> None:
    with TemporaryDirectory() as folder:
        file = Path(folder) / "file"
        text = table_text([{"view": "=1", "x": 0.1}, *({"view": a, "y": b} for a, b in rows)])
        file.write_text(text, encoding="utf-8", newline="")
        header, found = read_table(file)
    assert header == (["view", "x", "y"] if rows else ["view", "x"])
    assert found[0][:2] == ["=1", "0.1"]
    assert [[row[0], row[2]] for row in found[1:]] == rows


@pytest.mark.parametrize(
    ("number", "passes"),
    [(errno.EACCES, True), (errno.EIO, True), (errno.ESTALE, True), (errno.ENOENT, False)],
)
def test_an_error_that_may_pass_says_nothing_of_the_content(number: int, passes: bool) -> None:
    with pytest.raises(StoreError, match=r"^a/b: ") as raised, errors_named(Path("a/b")):
        raise OSError(number, os.strerror(number), "b")
    assert isinstance(raised.value, UnreadableError) == passes
