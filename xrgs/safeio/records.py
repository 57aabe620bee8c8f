"""Reads a store's JSON files and CSV tables, whoever wrote them, and writes such tables."""

from __future__ import annotations

import csv
import errno
import io
import math
from contextlib import contextmanager
from itertools import islice
from typing import TYPE_CHECKING, Any

from xrgs.errors import StoreError, UnreadableError
from xrgs.safeio import untrusted
from xrgs.safeio.confined import RootMissingError, confined, is_passing

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence
    from pathlib import Path

    from xrgs.safeio.confined import ConfinedPath


#: The largest JSON or CSV file of a cell or a variant that is read, in bytes. The longest are the
#: status of a cell (110 bytes for each of its files: 1.2 MB with 10,000 test views) and its history
#: (at most 1,000 rows). Read into Python's objects, a hostile file takes thirty times as much.
MAX_BYTES = 1 << 22
#: The largest magnitude of a number in a file. Nothing that is measured comes near it, and with it
#: no mean, spread or difference of numbers leaves the range of a float.
MAX_NUMBER = 1e30
#: The most lines and columns of a table. A cell's scores have a row for each test view.
_MAX_ROWS, _MAX_COLUMNS = 20_002, 1000


@contextmanager
def errors_named(path: Path | ConfinedPath) -> Iterator[None]:
    """Turn each OSError of a block into a StoreError whose message names a file.

    Args:
        path: The file or folder that the block works on.

    Yields:
        Nothing.

    Raises:
        UnreadableError: The system can't read it now; nothing is known of its content.
        StoreError: It is missing, too large, a link, or not what it should be.
    """
    try:
        yield
    except OSError as error:
        kind = UnreadableError if is_passing(error) else StoreError
        why = "is a link, which is not followed" if error.errno == errno.ELOOP else error.strerror
        raise kind(f"{path}: {why}") from error


def read_file(path: Path | ConfinedPath, max_bytes: int = MAX_BYTES) -> bytes:
    """Read a regular file of a store.

    Args:
        path: The file.
        max_bytes: The largest size that is read.

    Returns:
        The content.

    Raises:
        StoreError: As `errors_named`.
    """
    with errors_named(path):
        return confined(path).read_bytes(max_bytes)


def list_folder(path: ConfinedPath) -> list[str]:
    """Return the names in a folder of a store, sorted; none where there is no such folder.

    Args:
        path: The folder.

    Returns:
        The names; any of them may be a link or a pipe, or not be UTF-8 (it has lone surrogates).

    Raises:
        UnreadableError: It can't be read now, or its root is gone.
        StoreError: It is a link or not a folder.
    """
    with errors_named(path):
        try:
            return path.names()
        except RootMissingError:
            raise
        except FileNotFoundError:
            return []


def read_json(path: Path | ConfinedPath, max_bytes: int = MAX_BYTES) -> Any:
    """Read the JSON value in a file.

    Args:
        path: The file.
        max_bytes: The largest size that is read.

    Returns:
        Dicts, lists, strings, numbers, booleans and None.

    Raises:
        UnreadableError: As `read_file`.
        StoreError: The file is missing or not JSON; the message names it.
    """
    content = read_file(path, max_bytes)
    try:
        return untrusted.parse_json(content)
    except ValueError as error:
        raise StoreError(f"{path}: {error}") from error


def read_object(path: Path | ConfinedPath, max_bytes: int = MAX_BYTES) -> dict[str, Any]:
    """Read the JSON object in a file.

    Args:
        path: The file.
        max_bytes: The largest size that is read.

    Returns:
        The object's values by key.

    Raises:
        StoreError: As `read_json`, or the value is not an object.
    """
    value = read_json(path, max_bytes)
    if not isinstance(value, dict):
        raise StoreError(f"{path}: not a JSON object")
    return value


def read_table(path: Path | ConfinedPath) -> tuple[list[str], list[list[str]]]:
    """Read a CSV table.

    Args:
        path: The file.

    Returns:
        The header, whose names are distinct, and the rows, each as long as the header.

    Raises:
        UnreadableError: As `read_file`.
        StoreError: The file is missing or not such a table; the message names it.
    """
    content = read_file(path)
    try:
        text = content.decode("utf-8")
        header, *rows = islice(csv.reader(io.StringIO(text, newline=""), strict=True), _MAX_ROWS)
    except (ValueError, csv.Error) as error:
        raise StoreError(f"{path}: {error}") from error
    if len(rows) > _MAX_ROWS - 2 or len(header) > _MAX_COLUMNS:
        raise StoreError(f"{path}: more than {_MAX_ROWS - 2} rows or {_MAX_COLUMNS} columns")
    if not header:
        raise StoreError(f"{path}: the header is empty")
    if len(set(header)) < len(header) or any(len(row) != len(header) for row in rows):
        raise StoreError(
            f"{path}: two columns have one name, or a row is not as long as the header"
        )
    return header, rows


def table_text(rows: Sequence[Mapping[str, object]]) -> str:
    """Return a CSV table whose texts are exactly as they are given, so that they can be read back.

    In a table that is made for people, each text must have gone through `words.for_csv`.

    Args:
        rows: One mapping a row, of values by column, whose texts have no control characters. A
            value that a row lacks is empty.
    """
    text = io.StringIO()
    columns = list(dict.fromkeys(column for row in rows for column in row))
    writer = csv.DictWriter(text, columns, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


def as_number(value: object) -> float:
    """Convert a value of a JSON or CSV file to a float.

    Args:
        value: A number, its text, None or the empty string.

    Returns:
        The number; NaN for None and the empty string.

    Raises:
        ValueError: The value is something else, or finite and beyond `MAX_NUMBER`.
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
