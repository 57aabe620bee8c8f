"""Writes files atomically: a reader sees the old content or the new, never a part of either."""

from __future__ import annotations

import json
import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

from xrgs.safeio.files import sync_name


@contextmanager
def atomic_writer(path: Path, *, durable: bool = True) -> Iterator[IO[bytes]]:
    """Open a binary stream whose content replaces a file when the block ends without an exception.

    The content is written to a temporary file in the same folder, which must exist, and is renamed
    at the end. If that fails with an OSError, the old file is as it was. A `durable` file is waited
    for until content and name are on the disk; else the new content can be lost in a power failure.
    An OSError of writing has the name of the file, `path`.
    """
    # Not mkstemp: only the owner could read its files, and a store is shared by a team.
    temporary = path.with_name(f".{path.name}.{os.getpid()}-{secrets.token_hex(4)}")
    try:
        with temporary.open("xb") as stream:
            yield stream
            stream.flush()
            if durable:
                os.fsync(stream.fileno())
        temporary.replace(path)
    except OSError as error:
        temporary.unlink(missing_ok=True)
        # A full disk names no file, and the temporary one's name tells nobody anything.
        if error.errno is None or error.filename not in {None, str(temporary)}:
            raise
        raise OSError(error.errno, error.strerror, str(path)) from error
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
    if durable:
        sync_name(path)


def write_text(path: Path, text: str, *, durable: bool = True) -> None:
    """Write a UTF-8 text file atomically, see `atomic_writer`."""
    with atomic_writer(path, durable=durable) as stream:
        stream.write(text.encode("utf-8"))


def write_json(path: Path, value: object, *, durable: bool = True) -> None:
    """Write a value atomically as indented JSON with sorted keys, see `atomic_writer`."""
    write_text(path, json_text(value), durable=durable)


def json_text(value: object) -> str:
    """Return the JSON that `write_json` writes."""
    return json.dumps(value, indent=1, sort_keys=True, ensure_ascii=False) + "\n"
