"""Reads the JSON and CSV files of a store, each decoded by its declared type."""

from __future__ import annotations

import csv
import io
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from itertools import islice
from pathlib import Path
from typing import TypeVar

import msgspec

from xrgs.errors import StoreError, UnreadableError
from xrgs.safeio.files import is_transient, list_names, read_bytes

_T = TypeVar("_T")

#: The largest file that is decoded, in bytes. A configuration has 10 kB, a history 0.5 MB.
MAX_BYTES = 1 << 22
#: The largest magnitude of a number in a file. No measured value comes near it, and sums and
#: squares of such numbers stay in the range of a float.
MAX_NUMBER = 1e30
#: The most rows and columns of a table. A cell's scores have a row for each test view.
_MAX_ROWS, _MAX_COLUMNS = 20_000, 1000
#: msgspec's message for a text that does not match its pattern. Only names and paths have one.
_PATTERN = re.compile(r"Expected `str` matching regex .*")


@contextmanager
def errors_named(path: Path) -> Iterator[None]:
    """Turn each OSError of a block into a StoreError that names the file.

    Raises:
        UnreadableError: The file can't be read now; nothing is known of its content.
        StoreError: The file is missing, too large, or not a regular file.
    """
    try:
        yield
    except OSError as error:
        kind = UnreadableError if is_transient(error) else StoreError
        raise kind(f"{path}: {error.strerror}") from error


def read_file(path: Path, max_bytes: int = MAX_BYTES) -> bytes:
    """Read a file of a store; raises as `errors_named`."""
    with errors_named(path):
        return read_bytes(path, max_bytes)


def list_folder(path: Path) -> list[str]:
    """Return the sorted names in a folder of a store; none where there is no such folder."""
    with errors_named(path):
        try:
            return list_names(path)
        except FileNotFoundError:
            return []


def read_struct(path: Path, kind: type[_T], max_bytes: int = MAX_BYTES) -> _T:
    """Read a JSON file of a declared type, a `msgspec.Struct` or another that msgspec decodes.

    Raises:
        UnreadableError: The file can't be read now.
        StoreError: The file is missing or damaged; the message names the file and the field.
    """
    return decode_struct(read_file(path, max_bytes), kind, path)


def decode_struct(content: bytes, kind: type[_T], path: Path | str) -> _T:
    """Decode JSON of a declared type; `path` names its file in errors, see `read_struct`."""
    try:
        return msgspec.json.decode(content, type=kind)
    except msgspec.ValidationError as error:
        # "Expected `int`, got `str` - at `$.views[0]`"; "... - at `key` in `$.files`"
        what, _, where = str(error).partition(" - at ")
        field = where.replace("`", "").replace("$.", "") or "the file"
        what = _PATTERN.sub("not a name, or not a path inside the folder", what)
        raise StoreError(f"damaged: {path}: {field}: {what}") from error
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise StoreError(f"damaged: {path}: not valid JSON ({error})") from error


def read_table(path: Path) -> tuple[list[str], list[list[str]]]:
    """Read a CSV table: the header, whose names are distinct, and rows as long as the header.

    It raises as `read_struct` does.
    """
    content = read_file(path)
    try:
        reader = csv.reader(io.StringIO(content.decode("utf-8"), newline=""), strict=True)
        header, *rows = islice(reader, _MAX_ROWS + 2)
    except (ValueError, csv.Error) as error:
        raise StoreError(f"damaged: {path}: {error}") from error
    if len(rows) > _MAX_ROWS or len(header) > _MAX_COLUMNS:
        raise StoreError(f"{path}: more than {_MAX_ROWS} rows or {_MAX_COLUMNS} columns")
    if not header or len(set(header)) < len(header):
        raise StoreError(f"damaged: {path}: the header is empty or has one name twice")
    short = next((number for number, row in enumerate(rows) if len(row) != len(header)), None)
    if short is not None:
        raise StoreError(f"damaged: {path}: row {short + 1} is not as long as the header")
    return header, rows


def table_text(rows: Sequence[Mapping[str, object]]) -> str:
    """Return a CSV table whose texts are kept exactly, so that `read_table` gives them back.

    A value that a row lacks is empty. In a table that is made for people, each text must have gone
    through `sanitize.for_csv`.
    """
    text = io.StringIO()
    columns = list(dict.fromkeys(column for row in rows for column in row))
    writer = csv.DictWriter(text, columns, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


def as_number(value: object) -> float:
    """Convert a value of a JSON or CSV file to a float; NaN for None and the empty string.

    ValueError if the value is not a number, or is finite and beyond `MAX_NUMBER`.
    """
    if value is None or value == "":
        return math.nan
    if isinstance(value, bool) or not isinstance(value, (int, float, str)):
        raise ValueError(f"{value!r:.40} is not a number")
    try:
        number = float(value)
    except OverflowError:  # of an int
        raise ValueError("a number is out of range") from None
    if math.isfinite(number) and abs(number) > MAX_NUMBER:
        raise ValueError(f"{number} is out of range")
    return number
