"""Reads bytes and names that somebody else may have made: stores, photographs, weights.

Nothing in them is executed, no name in them leads outside its folder, and none of them makes this
process use more memory than the size of the file suggests.
"""

from __future__ import annotations

import errno
import json
import os
import re
import shutil
import stat
from pathlib import Path
from typing import Any, BinaryIO

#: The largest file that is read whole. The record of a sweep of a million cells takes half of it.
MAX_BYTES = 1 << 29
#: The deepest nesting of JSON. Our own files have six levels; Python's own limit, far above this,
#: is a RecursionError and not a ValueError.
_MAX_DEPTH = 50
#: The longest name in bytes: file systems end at 255, and `.png` may be appended.
_MAX_NAME_BYTES = 251
_NOT_IN_NAMES = re.compile(r"[/\\\x00-\x1f\x7f-\x9f\ud800-\udfff]")


def open_regular(file: Path) -> BinaryIO:
    """Open a regular file for reading, without following a link in the last part of its path.

    A link could lead out of the folder that is to be read, and opening a named pipe would block
    forever. The folders on the way to the file may be links.

    Args:
        file: The file.

    Returns:
        A binary stream.

    Raises:
        OSError: The file is missing, a link, a pipe, a device or a folder.
    """
    descriptor = os.open(file, os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK)
    try:
        if not stat.S_ISREG(os.fstat(descriptor).st_mode):
            raise OSError(errno.EINVAL, "not a regular file", str(file))
        return os.fdopen(descriptor, "rb")
    except BaseException:
        os.close(descriptor)
        raise


def read_bytes(file: Path, max_bytes: int = MAX_BYTES) -> bytes:
    """Read all of a regular file.

    Args:
        file: The file.
        max_bytes: The largest size that is read; a file of exactly this size is.

    Returns:
        The content.

    Raises:
        OSError: As `open_regular`, or the file is larger than `max_bytes`.
    """
    with open_regular(file) as stream:
        size = os.fstat(stream.fileno()).st_size
        if size > max_bytes:
            raise OSError(errno.EFBIG, f"{size} bytes, at most {max_bytes} are read", str(file))
        return stream.read()


def parse_json(content: bytes) -> Any:
    """Parse UTF-8 JSON of bounded depth whose strings can be encoded again.

    Args:
        content: The bytes of the JSON text.

    Returns:
        Dicts, lists, strings, numbers, booleans and None.

    Raises:
        ValueError: It is not JSON, is nested more than 50 levels deep, or has a string with half
            of a surrogate pair, which could be neither printed nor written.
    """
    text = content.decode("utf-8")
    try:
        value = json.loads(text)
    except RecursionError:
        raise ValueError("nested too deeply") from None
    if "\\u" in text:
        json.dumps(value, ensure_ascii=False).encode()  # fails on half of a surrogate pair
    if text.count("[") + text.count("{") > _MAX_DEPTH:
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


def remove(path: Path) -> None:
    """Remove a file, a folder with all that is in it, or a link, but never what a link leads to.

    Args:
        path: What to remove; nothing happens where nothing is there.

    Raises:
        OSError: It is there and can't be removed.
    """
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)
