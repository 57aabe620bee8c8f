"""Reads a store's JSON files and CSV tables, whoever wrote them, and writes such tables."""

from __future__ import annotations

import csv
import io
import math
from typing import TYPE_CHECKING, Any

from xrgs.errors import StoreError
from xrgs.safeio import untrusted

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path


def read_json(path: Path) -> Any:
    """Read the JSON value in a file.

    Args:
        path: The file, of at most `untrusted.MAX_BYTES` bytes.

    Returns:
        Dicts, lists, strings, numbers, booleans and None.

    Raises:
        StoreError: The file is missing, unreadable or not JSON; the message names it.
    """
    try:
        return untrusted.parse_json(untrusted.read_bytes(path))
    except (OSError, ValueError) as error:
        raise StoreError(f"{path}: {error}") from error


def read_object(path: Path) -> dict[str, Any]:
    """Read the JSON object in a file.

    Args:
        path: The file.

    Returns:
        The object's values by key.

    Raises:
        StoreError: As `read_json`, or the value is not an object.
    """
    value = read_json(path)
    if not isinstance(value, dict):
        raise StoreError(f"{path}: not a JSON object")
    return value


def read_table(path: Path) -> tuple[list[str], list[list[str]]]:
    """Read a CSV table.

    Args:
        path: The file.

    Returns:
        The header, whose names are distinct, and the rows, each as long as the header.

    Raises:
        StoreError: The file is missing, unreadable or not such a table; the message names it.
    """
    try:
        text = untrusted.read_bytes(path).decode("utf-8")
        header, *rows = csv.reader(io.StringIO(text, newline=""), strict=True)
    except (OSError, ValueError, csv.Error) as error:
        raise StoreError(f"{path}: {error}") from error
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
        ValueError: The value is something else, or too large for a float.
    """
    if value is None or value == "":
        return math.nan
    if isinstance(value, bool) or not isinstance(value, (int, float, str)):
        raise ValueError(f"{value!r:.40} is not a number")
    try:
        return float(value)
    except OverflowError as error:
        raise ValueError("a number is too large for a float") from error
