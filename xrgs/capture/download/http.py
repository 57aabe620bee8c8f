"""Downloads a file from a web server, and resumes an interrupted download."""

from __future__ import annotations

import fcntl
import re
from contextlib import contextmanager
from http.client import HTTPException
from typing import IO, TYPE_CHECKING
from urllib.error import HTTPError, URLError
from urllib.parse import urlsplit
from urllib.request import Request, urlopen

from xrgs.errors import XrgsError
from xrgs.runtime.progress import ProgressBar
from xrgs.safeio.hashing import file_digest

if TYPE_CHECKING:
    from collections.abc import Iterator
    from http.client import HTTPResponse
    from pathlib import Path

_TIMEOUT = 30.0  # seconds without a byte
_CHUNK = 1 << 18


class DownloadError(XrgsError):
    """A file can't be downloaded; the message names the address and the file."""


class TooLargeError(DownloadError):
    """A file is larger than allowed."""


class _ConnectionLost(Exception):  # noqa: N818  caught in this module, and never shown
    """The server can't be reached, or the connection ended early."""


def is_url(text: str) -> bool:
    """Tell whether a text is an address that `download` can read.

    Args:
        text: Any text.

    Returns:
        True for http and https addresses.
    """
    return urlsplit(text).scheme in ("http", "https")


def download(url: str, target: Path, max_bytes: int, sha256: str = "") -> None:
    """Download a file; what an interrupted download received is kept in `<target>.part`.

    A lost connection is resumed for as long as each attempt receives something.

    Args:
        url: An http or https address.
        target: The file to write; its folder is made. Only a complete file ever has this name.
        max_bytes: The largest size that is accepted, whatever the server announces or sends.
        sha256: The expected SHA-256, in hexadecimal; empty to verify nothing.

    Raises:
        TooLargeError: The file is larger than `max_bytes`; what was received is kept, for a call
            with a larger one.
        DownloadError: The server is unreachable or refuses, the content has another hash, or the
            disk can't take it.
    """
    if not is_url(url):
        raise DownloadError(f"{url or 'an empty address'}: only http and https are read")
    part = target.with_name(f"{target.name}.part")
    try:
        part.parent.mkdir(parents=True, exist_ok=True)
        with part.open("ab") as stream, _exclusive(stream, target):
            _receive_all(url, stream, target, max_bytes)
        if sha256 and (actual := file_digest(part)) != sha256.lower():
            part.unlink()
            raise DownloadError(f"{url}: sha256 is {actual}, expected {sha256}; it was not kept")
        part.replace(target)
    except OSError as error:
        raise DownloadError(f"{part}: {error.strerror or error}") from error


@contextmanager
def _exclusive(stream: IO[bytes], target: Path) -> Iterator[None]:
    """Lock the file: two processes that append to it would spoil it."""
    try:
        fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        raise DownloadError(f"{target}: another process is downloading it") from error
    yield


def _receive_all(url: str, stream: IO[bytes], target: Path, max_bytes: int) -> None:
    """Receive until the file is complete, or an attempt brings nothing."""
    while True:
        before = stream.tell()
        try:
            _receive(url, stream, target.name, max_bytes)
            return
        except _ConnectionLost as lost:
            if stream.tell() > before:
                continue
            kept = f"; {before} bytes are kept for the next attempt" if before else ""
            raise DownloadError(f"{url}: can't be downloaded ({lost}) to {target}{kept}") from lost


def _receive(url: str, stream: IO[bytes], label: str, max_bytes: int) -> None:
    """Request and append the missing part of the file.

    Raises:
        _ConnectionLost: The server can't be reached, or the connection ended early.
        DownloadError: The server has no such file, or one that is too large.
        OSError: The disk can't take it.
    """
    received = stream.tell()
    headers = {"User-Agent": "xrgs", "Accept-Encoding": "identity"}
    if received:
        headers["Range"] = f"bytes={received}-"
    try:
        response = urlopen(Request(url, headers=headers), timeout=_TIMEOUT)  # noqa: S310  is_url
    except HTTPError as error:
        error.close()
        if error.code != 416 or not received:
            raise DownloadError(f"{url}: the server says {error.code} {error.reason}") from error
        if _parse_range(error.headers.get("Content-Range"))[1] != received:
            _truncate(stream)  # more than the file has: it is of another one
            _receive(url, stream, label, max_bytes)
        _check_size(url, stream.tell(), max_bytes)
        return  # the whole file was received before
    except (URLError, OSError, HTTPException) as error:
        raise _ConnectionLost(str(getattr(error, "reason", error))) from error
    with response:
        _append(url, response, stream, label, max_bytes)


def _append(
    url: str, response: HTTPResponse, stream: IO[bytes], label: str, max_bytes: int
) -> None:
    if response.headers.get_content_type() == "text/html":
        raise DownloadError(f"{url}: the server sent a web page, not the file")
    length = response.headers.get("Content-Length")
    total = int(length) if length else None
    start, length_of_file = _parse_range(response.headers.get("Content-Range"))
    if response.status == 206 and start == stream.tell():
        total = length_of_file
    elif response.status == 206:
        raise DownloadError(
            f"{url}: requested the bytes from {stream.tell()} on, received those from {start} on"
        )
    _check_size(url, total or 0, max_bytes)
    if response.status != 206:
        _truncate(stream)  # the server does not support ranges: start again
    with ProgressBar(label, "byte", total, done=stream.tell()) as bar:
        while chunk := _read(response):
            _check_size(url, stream.tell() + len(chunk), max_bytes)
            stream.write(chunk)
            bar.update(len(chunk))
    if total is not None and stream.tell() != total:
        raise _ConnectionLost(f"the connection ended after {stream.tell()} of {total} bytes")


def _check_size(url: str, size: int, max_bytes: int) -> None:
    if size > max_bytes:
        raise TooLargeError(f"{url}: {size} bytes or more, and at most {max_bytes} are allowed")


def _truncate(stream: IO[bytes]) -> None:
    stream.seek(0)
    stream.truncate()


def _read(response: HTTPResponse) -> bytes:
    try:
        return response.read(_CHUNK)
    except (OSError, HTTPException) as error:
        raise _ConnectionLost(str(error) or repr(error)) from error


def _parse_range(header: str | None) -> tuple[int | None, int | None]:
    """Parse the first byte and the total length of a `Content-Range`, each None if missing."""
    match = re.fullmatch(r"bytes (?:(\d+)-\d+|\*)/(\d+|\*)", header or "")
    if match is None:
        return None, None
    start, total = match.groups()
    return (int(start) if start else None), (int(total) if total.isdigit() else None)
