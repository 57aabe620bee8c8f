"""Reads bytes and names that somebody else may have made: stores, photographs, weights.

Nothing in them is executed, no name in them leads outside its folder, and none of them makes this
process use more memory than the size of the file suggests.
"""

from __future__ import annotations

import json
import re
from typing import Any

#: The deepest nesting of JSON. Our own files have six levels; Python's own limit, far above this,
#: is a RecursionError and not a ValueError.
_MAX_DEPTH = 50
#: The most lists and objects in a JSON text. The record of 100,000 cells has as many; an empty list
#: takes thirty times the memory of its text.
_MAX_CONTAINERS = 1_000_000
#: The longest name in bytes: file systems end at 255, and `.png` may be appended.
_MAX_NAME_BYTES = 251
_NOT_IN_NAMES = re.compile(r"[/\\\x00-\x1f\x7f-\x9f\ud800-\udfff]")


def parse_json(content: bytes) -> Any:
    """Parse UTF-8 JSON of bounded depth and size whose strings can be encoded again.

    Args:
        content: The bytes of the JSON text.

    Returns:
        Dicts, lists, strings, numbers, booleans and None.

    Raises:
        ValueError: It is not JSON, is nested more than 50 levels deep, has more than a million
            lists and objects, or has a string with half of a surrogate pair, which could be neither
            printed nor written.
    """
    text = content.decode("utf-8")
    containers = text.count("[") + text.count("{")
    if containers > _MAX_CONTAINERS:
        raise ValueError(f"more than {_MAX_CONTAINERS} lists and objects")
    try:
        value = json.loads(text)
    except RecursionError:
        raise ValueError("nested too deeply") from None
    if "\\u" in text:
        json.dumps(value, ensure_ascii=False).encode()  # fails on half of a surrogate pair
    if containers > _MAX_DEPTH:
        _check_depth(value)
    return value


def _check_depth(value: Any) -> None:
    level = [value]
    for _ in range(_MAX_DEPTH):
        level = [
            inner
            for outer in level
            if isinstance(outer, (dict, list))
            for inner in (outer.values() if isinstance(outer, dict) else outer)
        ]
        if not level:
            return
    raise ValueError("nested too deeply")


def is_name(value: object) -> bool:
    """Tell whether a value can safely name one file or folder.

    Args:
        value: Anything; only strings can be names.

    Returns:
        True for a string of at most 251 bytes that has no slash, backslash, control character or
        lone surrogate, and is neither empty, `.` nor `..`. Any script, spaces and quotes may be in
        it.
    """
    if not isinstance(value, str) or value in {"", ".", ".."} or _NOT_IN_NAMES.search(value):
        return False
    return len(value.encode("utf-8")) <= _MAX_NAME_BYTES


def is_inside(value: object) -> bool:
    """Tell whether a value is a relative path that stays below the folder it is relative to.

    Args:
        value: Anything; only strings can be paths.

    Returns:
        True where every part between slashes satisfies `is_name`.
    """
    return isinstance(value, str) and all(is_name(part) for part in value.split("/"))
