"""Keeps the part of a file that was downloaded so far, and of which version of it."""

from __future__ import annotations

import fcntl
import os
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from typing import IO, TYPE_CHECKING

from xrgs.errors import XrgsError
from xrgs.safeio import untrusted
from xrgs.safeio.atomic import write_json
from xrgs.safeio.confined import ConfinedPath
from xrgs.safeio.hashing import file_digest

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

#: The largest record that is read, in bytes.
_MAX_BYTES = 1 << 16


class DownloadError(XrgsError):
    """A file can't be downloaded; the message names the address and the file."""


@dataclass(frozen=True)
class Version:
    """The version of a server's file that a part is of."""

    url: str = ""
    """The address that it was requested from."""
    validator: str = ""
    """The strong ETag or the Last-Modified that the server gave; empty where it gave none."""
    total: int | None = None
    """The file's size in bytes; None where the server did not say it."""


class Part:
    """The file `<target>.part`, and beside it `<target>.part.json` with its version."""

    def __init__(self, target: ConfinedPath, stream: IO[bytes]) -> None:
        self.target, self._file = target, _file_of(target)
        self._record = target.with_name(f"{target.name}.part.json")
        self._stream = stream
        self.version = _read_version(self._record)
        self.joined = self.size > 0
        """Whether the bytes may come from more than one answer of the server."""

    @property
    def size(self) -> int:
        """The number of bytes so far."""
        return self._stream.tell()

    def begin(self, version: Version) -> None:
        """Discard all bytes; those that are appended from now on are of another version.

        Args:
            version: Their version; it is on the disk before the first of them is.

        Raises:
            OSError: The disk can't take it.
        """
        self._stream.seek(0)
        self._stream.truncate()
        os.fsync(self._stream.fileno())
        write_json(self._record, asdict(version))
        self.version, self.joined = version, False

    def append(self, chunk: bytes) -> None:
        """Append bytes.

        Args:
            chunk: The bytes.

        Raises:
            OSError: The disk can't take them.
        """
        self._stream.write(chunk)

    def digest(self) -> str:
        """Return the SHA-256 of all bytes, in hexadecimal.

        Raises:
            OSError: The file can't be written or read.
        """
        self._stream.flush()
        return file_digest(self._file)

    def remove(self) -> None:
        """Remove the part and its record.

        Raises:
            OSError: They can't be removed.
        """
        self._file.unlink()
        self._record.unlink(missing_ok=True)

    def complete(self) -> None:
        """Give the file its own name, once all of it is on the disk.

        Raises:
            OSError: The disk can't take it.
        """
        self._stream.flush()
        os.fsync(self._stream.fileno())
        self._file.rename(self.target)
        self._record.unlink(missing_ok=True)
        self.target.sync_name()


@contextmanager
def open_part(target: Path) -> Iterator[Part]:
    """Open the part of a file for this process alone; two that append to it would spoil it.

    Args:
        target: The file; its folder is made.

    Yields:
        The part, which may hold bytes of an earlier download.

    Raises:
        DownloadError: Another process is downloading the file.
        OSError: The part can't be written.
    """
    folder = ConfinedPath(target.parent)
    folder.make_root()
    file = _file_of(folder / target.name)
    with file.append() as stream:
        try:
            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
            # The process that held the lock until now may have given the file its own name.
            opened = os.fstat(stream.fileno())
            is_current = file.identity() == (opened.st_dev, opened.st_ino)
        except (BlockingIOError, FileNotFoundError):
            is_current = False
        if not is_current:
            raise DownloadError(f"{target}: another process is downloading it")
        yield Part(folder / target.name, stream)


def _file_of(target: ConfinedPath) -> ConfinedPath:
    return target.with_name(f"{target.name}.part")


def _read_version(record: ConfinedPath) -> Version:
    """Read the version that a part is of; an unknown one where the record is missing or damaged."""
    try:
        content = untrusted.parse_json(record.read_bytes(_MAX_BYTES))
        version = Version(content["url"], content["validator"], content["total"])
        texts = isinstance(version.url, str) and isinstance(version.validator, str)
        # The validator becomes a header of a request.
        if texts and version.validator.isascii() and version.validator.isprintable():
            return version
    except (OSError, ValueError, KeyError, TypeError):
        pass
    return Version()
