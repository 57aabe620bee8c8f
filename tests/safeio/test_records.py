"""JSON files and CSV tables that anybody may have written."""

from __future__ import annotations

import errno
import math
import os
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
from hypothesis import given
from hypothesis import strategies as st

from xrgs.errors import StoreError, UnreadableError, XrgsError
from xrgs.safeio.confined import ConfinedPath
from xrgs.safeio.records import (
    MAX_BYTES,
    as_number,
    errors_named,
    list_folder,
    read_file,
    read_json,
    read_object,
    read_table,
    table_text,
)


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return tmp_path / "file"


def test_json_is_read_or_refused_by_name(file: Path) -> None:
    file.write_text("[1, null]")
    assert read_json(file) == [1, None]
    for content in (b"", b"{", b"\xff"):
        file.write_bytes(content)
        with pytest.raises(StoreError, match=f"{file}: "):
            read_json(file)
    file.unlink()
    with pytest.raises(StoreError, match=str(file)):
        read_json(file)
    assert issubclass(StoreError, XrgsError)


def test_an_object_is_read_and_nothing_else(file: Path) -> None:
    file.write_text('{"a": 1}')
    assert read_object(file) == {"a": 1}
    file.write_text("[1]")
    with pytest.raises(StoreError, match="not a JSON object"):
        read_object(file)


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


@pytest.mark.parametrize(
    ("value", "number"), [(1, 1.0), (1.5, 1.5), ("1e3", 1000.0), ("inf", math.inf)]
)
def test_numbers_are_read(value: object, number: float) -> None:
    assert as_number(value) == number


@pytest.mark.parametrize("value", [math.inf, "-inf", "1e400", 1e30, "-1e30"])
def test_infinity_and_the_largest_number_are_numbers(value: float | str) -> None:
    assert as_number(value) == float(value)


@pytest.mark.parametrize("value", [None, ""])
def test_a_missing_number_is_nan(value: object) -> None:
    assert math.isnan(as_number(value))


@pytest.mark.parametrize("value", [True, [], {}, "x", 10**400, 1.1e30, "-1.1e30", "1e308"])
def test_anything_else_is_not_a_number(value: object) -> None:
    with pytest.raises(ValueError):  # noqa: PT011 - float's own messages
        as_number(value)


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


def test_a_file_of_exactly_the_bound_is_read_and_a_larger_one_is_named(file: Path) -> None:
    file.write_bytes(bytes(MAX_BYTES))
    assert len(read_file(file)) == MAX_BYTES
    file.write_bytes(bytes(MAX_BYTES + 1))
    with pytest.raises(StoreError, match=f"file: {MAX_BYTES + 1} bytes, at most {MAX_BYTES}"):
        read_file(file)


def test_a_table_has_at_most_20000_rows_and_1000_columns(file: Path) -> None:
    file.write_text("a\n" + "1\n" * 20_000)
    assert len(read_table(file)[1]) == 20_000
    file.write_text("a\n" + "1\n" * 20_001)
    with pytest.raises(StoreError, match="more than 20000 rows"):
        read_table(file)
    file.write_text(",".join(map(str, range(1000))))
    assert len(read_table(file)[0]) == 1000
    file.write_text(",".join(map(str, range(1001))))
    with pytest.raises(StoreError, match="1000 columns"):
        read_table(file)


def test_a_folder_is_listed_or_named(tmp_path: Path) -> None:
    root = ConfinedPath(tmp_path)
    (tmp_path / "b").mkdir()
    (tmp_path / "a").symlink_to("gone")
    assert list_folder(root) == ["a", "b"]
    assert list_folder(root / "none") == []
    for name in ("a", "a/inside"):
        with pytest.raises(StoreError, match=name) as refused:
            list_folder(root / name)
        assert not isinstance(refused.value, UnreadableError)
    with pytest.raises(UnreadableError, match="none"):
        list_folder(ConfinedPath(tmp_path / "none") / "cells")


@pytest.mark.parametrize(
    ("number", "passes"),
    [(errno.EACCES, True), (errno.EIO, True), (errno.ESTALE, True), (errno.ENOENT, False)],
)
def test_an_error_that_may_pass_says_nothing_of_the_content(number: int, passes: bool) -> None:
    with pytest.raises(StoreError, match=r"^a/b: ") as raised, errors_named(Path("a/b")):
        raise OSError(number, os.strerror(number), "b")
    assert isinstance(raised.value, UnreadableError) == passes
    with pytest.raises(StoreError, match="a/b: is a link"), errors_named(Path("a/b")):
        raise OSError(errno.ELOOP, "too many links")
