"""Bytes that somebody else may have made: a store, a scene, weights from a stranger.

Nothing in them is run, no name in them leads anywhere else, and none of them takes more memory than
its own size lets one expect.
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

#: Of a file that is read whole. The record of a sweep of a million cells is half of it.
MOST_BYTES = 1 << 29
#: Levels of JSON: what we write has six, and Python's own limit is an error of another kind.
_DEEPEST = 50
#: Of a name in bytes: file systems end at 255, and `.png` is still to come.
_LONGEST_NAME = 251
_NOT_IN_NAMES = re.compile(r"[/\\\x00-\x1f\x7f-\x9f\ud800-\udfff]")


def open_regular(file: Path) -> BinaryIO:
    """A regular file, opened to be read; its folders may be links, itself it may not.

    A link would have us read what is not in the folder that we were given, and a named pipe wait
    for ever.

    Raises:
        OSError: missing, a link, a pipe, a device or a folder.
    """
    descriptor = os.open(file, os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK)
    try:
        if not stat.S_ISREG(os.fstat(descriptor).st_mode):
            raise OSError(errno.EINVAL, "not a regular file", str(file))
        return os.fdopen(descriptor, "rb")
    except BaseException:
        os.close(descriptor)
        raise


def read_bytes(file: Path, most: int = MOST_BYTES) -> bytes:
    """All of a regular file.

    Raises:
        OSError: as of `open_regular`, or it is larger than `most` bytes.
    """
    with open_regular(file) as stream:
        size = os.fstat(stream.fileno()).st_size
        if size > most:
            raise OSError(errno.EFBIG, f"{size} bytes, at most {most} are read", str(file))
        return stream.read()


def parse_json(content: bytes) -> Any:
    """JSON of a depth and with strings that can be handled further.

    Raises:
        ValueError: anything else; a string of no valid Unicode too, which couldn't be printed.
    """
    text = content.decode("utf-8")
    try:
        value = json.loads(text)
    except RecursionError:
        raise ValueError("nested too deeply") from None
    if "\\u" in text:
        json.dumps(value, ensure_ascii=False).encode()  # a half of a pair of surrogates
    if text.count("[") + text.count("{") > _DEEPEST:
        _check_depth(value)
    return value


def _check_depth(value: Any) -> None:
    level = [value]
    for _ in range(_DEEPEST):
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
    """Whether it can name one file or folder: nothing in it leads elsewhere or commands terminals.

    Any script, spaces, quotes and marks may be in it; slashes, control characters and what is no
    valid Unicode may not.
    """
    if not isinstance(value, str) or value in {"", ".", ".."} or _NOT_IN_NAMES.search(value):
        return False
    return len(value.encode("utf-8")) <= _LONGEST_NAME


def is_inside(value: object) -> bool:
    """Whether it is a path of such names, with `/`, below the folder that it is meant in."""
    return isinstance(value, str) and all(is_name(part) for part in value.split("/"))


def printable(text: str) -> str:
    """`text` with a space for what can't be printed: terminals obey some of that."""
    return "".join(char if char.isprintable() else " " for char in text)


def one_line(text: str) -> str:
    """`text` without line breaks, runs of spaces and what can't be printed."""
    return " ".join(printable(text).split())


def remove(path: Path) -> None:
    """Take a file or folder away; of a link itself, never what it leads to.

    Raises:
        OSError: it is there and can't be.
    """
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)
