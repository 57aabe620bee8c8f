"""What a store's files hold, whoever made them: JSON and tables, or an error that names them."""

from __future__ import annotations

import csv
import io
import math
from typing import TYPE_CHECKING, Any

from xrgs.errors import XrgsError
from xrgs.safeio import untrusted

if TYPE_CHECKING:
    from pathlib import Path

#: Begins the name of a folder in `variants/` that has a report of what was tried, and no variant.
FAILED = "failed-"


class StoreError(XrgsError):
    """The store's folder can't be used, or does not hold what was asked for."""


def read_json(path: Path) -> Any:
    """The JSON in a file.

    Raises:
        StoreError: the file is missing, unreadable or not JSON; the message names it.
    """
    try:
        return untrusted.parse_json(untrusted.read_bytes(path))
    except (OSError, ValueError) as error:
        raise StoreError(f"{path}: {error}") from error


def read_object(path: Path) -> dict[str, Any]:
    """The JSON in a file that must be values under names.

    Raises:
        StoreError: likewise, or it is not.
    """
    value = read_json(path)
    if not isinstance(value, dict):
        raise StoreError(f"{path}: no values under names")
    return value


def read_table(path: Path) -> tuple[list[str], list[list[str]]]:
    """Header and rows of a .csv, every row as long as the header, whose names differ.

    Raises:
        StoreError: the file is missing, unreadable or no such table; the message names it.
    """
    try:
        text = untrusted.read_bytes(path).decode("utf-8")
        header, *rows = csv.reader(io.StringIO(text, newline=""), strict=True)
    except (OSError, ValueError, csv.Error) as error:
        raise StoreError(f"{path}: {error}") from error
    if len(set(header)) < len(header) or any(len(row) != len(header) for row in rows):
        raise StoreError(f"{path}: rows and header do not fit")
    return header, rows


def as_number(value: object) -> float:
    """A number of a JSON or .csv file, NaN of none.

    Raises:
        ValueError: it is something else.
    """
    if value is None or value == "":
        return math.nan
    if isinstance(value, bool) or not isinstance(value, (int, float, str)):
        raise ValueError(f"{value!r:.40} is no number")
    try:
        return float(value)
    except OverflowError as error:
        raise ValueError("a number is too large") from error


def failed_scenes(variants: Path, key: str = "*") -> dict[str, tuple[str, str]]:
    """Scene and reason of every scene that could not be made into a variant, by the variant's key.

    Args:
        variants: the store's folder of them.
        key: of the only one that is wanted.
    """
    found = {}
    for folder in sorted(variants.glob(f"{FAILED}{key}")):
        try:
            report = read_object(folder / "report.json")
            found[folder.name.removeprefix(FAILED)] = str(report["scene"]), str(report["reason"])
        except (StoreError, KeyError):
            continue
    return found
