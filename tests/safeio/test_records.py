"""JSON files and CSV tables that anybody may have written."""

from __future__ import annotations

import math
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
from hypothesis import given
from hypothesis import strategies as st

from xrgs.errors import StoreError, XrgsError
from xrgs.safeio.records import as_number, read_json, read_object, read_table, table_text


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


@pytest.mark.parametrize("value", [None, ""])
def test_a_missing_number_is_nan(value: object) -> None:
    assert math.isnan(as_number(value))


@pytest.mark.parametrize("value", [True, [], {}, "x", 10**400])
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
