"""A file from a web server, resumed where it broke off, whole or not there at all."""

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
from xrgs.runtime.progress import Bar
from xrgs.safeio.hashing import file_digest

if TYPE_CHECKING:
    from collections.abc import Iterator
    from http.client import HTTPResponse
    from pathlib import Path

_TIMEOUT = 30.0  # seconds without a byte
_CHUNK = 1 << 18


class DownloadError(XrgsError):
    """A file that could not be had; the message names the address and the file."""


class TooLargeError(DownloadError):
    """A file of more bytes than were allowed."""


class _Cut(Exception):  # noqa: N818  caught here: a state, not an error that anyone is shown
    """The connection ended early."""


def is_url(text: str) -> bool:
    """Whether `text` is an address that `download` can read."""
    return urlsplit(text).scheme in ("http", "https")


def download(url: str, target: Path, max_bytes: int, sha256: str = "") -> None:
    """Fetch `url` into `target`; what came before a break waits in `<target>.part`.

    A broken connection is taken up again for as long as each try brings something.

    Args:
        url: http or https.
        target: The file; its folder is made. Only a whole file ever has this name.
        max_bytes: The most that is taken, whatever the server says or sends.
        sha256: What the content must have, in hexadecimal; empty: not verified.

    Raises:
        TooLargeError: it has more; what came of it waits, for a larger `max_bytes`.
        DownloadError: unreachable, refused, another content, or the disk can't take it.
    """
    if not is_url(url):
        raise DownloadError(f"{url or 'an empty address'}: only http and https are read")
    part = target.with_name(f"{target.name}.part")
    try:
        part.parent.mkdir(parents=True, exist_ok=True)
        with part.open("ab") as stream, _alone(stream, target):
            _all_of(url, stream, target, max_bytes)
        if sha256 and (found := file_digest(part)) != sha256.lower():
            part.unlink()
            raise DownloadError(f"{url}: sha256 is {found}, expected {sha256}; it was not kept")
        part.replace(target)
    except OSError as error:
        raise DownloadError(f"{part}: {error.strerror or error}") from error


@contextmanager
def _alone(stream: IO[bytes], target: Path) -> Iterator[None]:
    """Two processes that append to one file would spoil it."""
    try:
        fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        raise DownloadError(f"{target}: another process is downloading it") from error
    yield


def _all_of(url: str, stream: IO[bytes], target: Path, max_bytes: int) -> None:
    while True:
        before = stream.tell()
        try:
            _receive(url, stream, target.name, max_bytes)
            return
        except _Cut as cut:
            if stream.tell() > before:
                continue
            kept = f"; {before} bytes are kept for the next try" if before else ""
            raise DownloadError(f"{url}: can't be had ({cut}) for {target}{kept}") from cut


def _receive(url: str, stream: IO[bytes], label: str, max_bytes: int) -> None:
    """Append what is missing.

    Raises:
        _Cut: the server can't be reached, or the connection ended early.
        DownloadError: the server has no such file, or one that is too large.
        OSError: the disk.
    """
    have = stream.tell()
    headers = {"User-Agent": "xrgs", "Accept-Encoding": "identity"}
    if have:
        headers["Range"] = f"bytes={have}-"
    try:
        response = urlopen(Request(url, headers=headers), timeout=_TIMEOUT)  # noqa: S310  is_url
    except HTTPError as error:
        error.close()
        if error.code != 416 or not have:
            raise DownloadError(f"{url}: the server says {error.code} {error.reason}") from error
        if _span(error.headers.get("Content-Range"))[1] != have:
            _empty(stream)  # longer than the file: of another one
            _receive(url, stream, label, max_bytes)
        _not_beyond(url, stream.tell(), max_bytes)
        return  # all of it came before, and only its end was not seen
    except (URLError, OSError, HTTPException) as error:
        raise _Cut(str(getattr(error, "reason", error))) from error
    with response:
        _append(url, response, stream, label, max_bytes)


def _append(
    url: str, response: HTTPResponse, stream: IO[bytes], label: str, max_bytes: int
) -> None:
    if response.headers.get_content_type() == "text/html":
        raise DownloadError(f"{url}: the server sent a web page, not the file")
    length = response.headers.get("Content-Length")
    total = int(length) if length else None
    start, whole = _span(response.headers.get("Content-Range"))
    if response.status == 206 and start == stream.tell():
        total = whole
    elif response.status == 206:
        raise DownloadError(f"{url}: asked for what follows {stream.tell()}, given {start}")
    _not_beyond(url, total or 0, max_bytes)
    if response.status != 206:
        _empty(stream)  # the server knows no ranges: from the beginning
    with Bar(label, "byte", total, done=stream.tell()) as bar:
        while chunk := _read(response):
            _not_beyond(url, stream.tell() + len(chunk), max_bytes)
            stream.write(chunk)
            bar.update(len(chunk))
    if total is not None and stream.tell() != total:
        raise _Cut(f"the connection ended after {stream.tell()} of {total} bytes")


def _not_beyond(url: str, size: int, max_bytes: int) -> None:
    if size > max_bytes:
        raise TooLargeError(f"{url}: {size} bytes or more, and {max_bytes} is the most allowed")


def _empty(stream: IO[bytes]) -> None:
    stream.seek(0)
    stream.truncate()


def _read(response: HTTPResponse) -> bytes:
    try:
        return response.read(_CHUNK)
    except (OSError, HTTPException) as error:
        raise _Cut(str(error) or repr(error)) from error


def _span(header: str | None) -> tuple[int | None, int | None]:
    """First byte and whole length of a `Content-Range`, each None where it says none."""
    match = re.fullmatch(r"bytes (?:(\d+)-\d+|\*)/(\d+|\*)", header or "")
    if match is None:
        return None, None
    start, whole = match.groups()
    return (int(start) if start else None), (int(whole) if whole.isdigit() else None)
