"""Files that a reader sees whole: the old content or the new, never half of one."""

from __future__ import annotations

import json
import os
import secrets
from contextlib import contextmanager
from pathlib import Path
from typing import IO, TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterator


@contextmanager
def replacing(path: Path, *, durable: bool = True) -> Iterator[IO[bytes]]:
    """A stream whose content takes the place of a file at the end, if no exception comes before.

    What is not `durable` may be lost when the power goes, and doesn't wait for the disk.
    """
    # Not mkstemp: its files are for their owner alone, and a store is for a team.
    temporary = path.with_name(f".{path.name}.{os.getpid()}-{secrets.token_hex(4)}")
    try:
        with temporary.open("xb") as stream:
            yield stream
            stream.flush()
            if durable:
                os.fsync(stream.fileno())
        temporary.replace(path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


def write_text(path: Path, text: str, *, durable: bool = True) -> None:
    """Write a file so that a reader sees the old or the new content, never half of one."""
    with replacing(path, durable=durable) as stream:
        stream.write(text.encode("utf-8"))


def write_json(path: Path, value: object, *, durable: bool = True) -> None:
    """Write `value` as indented JSON with sorted keys, atomically."""
    text = json.dumps(value, indent=1, sort_keys=True, ensure_ascii=False) + "\n"
    write_text(path, text, durable=durable)


def path_of(text: str) -> Path:
    """The path that a person wrote: `~` is a home, and where nobody has that name, itself."""
    try:
        return Path(text).expanduser()
    except RuntimeError:
        return Path(text)
