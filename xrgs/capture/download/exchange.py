"""One request for a file, and the server's answer, of which nothing is believed unchecked.

aiohttp parses the answers, and refuses malformed ones. It is asynchronous, so that a time limit
holds for looking up the host, connecting and all headers together, however slowly they come.
"""

from __future__ import annotations

import asyncio
import os
import re
from dataclasses import dataclass
from email.utils import mktime_tz, parsedate_tz
from typing import TYPE_CHECKING

import aiohttp
from yarl import URL  # aiohttp's own class for addresses

from xrgs.capture.download.part import DownloadError, Version
from xrgs.runtime.progress import ProgressBar
from xrgs.safeio.sanitize import for_line

if TYPE_CHECKING:
    from collections.abc import Mapping

    from multidict import CIMultiDictProxy

    from xrgs.capture.download.part import Part

#: Seconds from a request to the end of the answer's headers, redirects included.
_ANSWER_S = 60.0
#: The least rate: this many bytes in each period of this many seconds.
LEAST_BYTES, _PERIOD_S = 60_000, 60.0
_MAX_REDIRECTS = 5
_REDIRECTS = frozenset({301, 302, 303, 307, 308})
_WEB_PAGES = frozenset({"text/html", "application/xhtml+xml"})
_STRONG_ETAG = re.compile(r'"[\x21\x23-\x7e]{1,200}"')
_CONTENT_RANGE = re.compile(r"bytes (?:(\d{1,15})-(\d{1,15})|\*)/(\d{1,15})")
#: The most characters of a server's own words in a message.
_MAX_WORDS = 120


class TooLargeError(DownloadError):
    """A file is larger than allowed."""


class ConnectionLostError(Exception):
    """This attempt failed, and another may not; it is never shown to the user."""

    def __init__(self, why: str, retry_after: float = 0) -> None:
        super().__init__(why)
        self.retry_after = retry_after
        """Seconds that the server asks to wait before the next attempt."""


@dataclass(frozen=True)
class Source:
    """A file on a web server, and what of it is accepted."""

    url: str
    max_bytes: int
    """The largest size, whatever the server announces or sends."""
    sha256: str = ""
    """The expected SHA-256, in lower-case hexadecimal; empty where it is not known."""
    redirect_hosts: tuple[str, ...] = ()
    """Hosts besides the address's own to which the server may redirect."""


def receive(source: Source, part: Part) -> None:
    """Request what is missing of a file, and append it; return once all of it is there.

    Args:
        source: The file.
        part: What was received so far.

    Raises:
        ConnectionLostError: The server can't be reached or used now, the connection ended early or
            was too slow, or the bytes so far are of another version and were discarded.
        TooLargeError: The file is larger than `source.max_bytes`.
        DownloadError: The server refuses, or sends something that is not the file.
        OSError: The disk can't take it.
    """
    try:
        asyncio.run(_receive(source, part))
    except (aiohttp.ClientConnectorCertificateError, aiohttp.InvalidURL) as error:
        raise DownloadError(f"{source.url}: {_words(str(error))}") from error
    except aiohttp.ClientResponseError as error:
        words = _words(error.message)
        raise DownloadError(f"{source.url}: the answer can't be used ({words})") from error
    except aiohttp.ClientConnectorError as error:
        code = error.os_error.errno or 0  # negative where the host's name is not known
        why = os.strerror(code) if code > 0 else error.strerror
        raise ConnectionLostError(f"{_words(error.host)}: {_words(why or str(error))}") from error
    except (aiohttp.ClientError, ConnectionError) as error:
        raise ConnectionLostError(_words(str(error) or type(error).__name__)) from error


async def _receive(source: Source, part: Part) -> None:
    async with aiohttp.ClientSession(
        headers=_request_headers(source, part),
        timeout=aiohttp.ClientTimeout(),  # none: the periods below are stricter
        auto_decompress=False,
        trust_env=True,  # the proxies that the environment names
    ) as session:
        try:
            async with asyncio.timeout(_ANSWER_S):
                response = await _request(session, source)
        except TimeoutError:
            raise ConnectionLostError(f"no complete answer in {_ANSWER_S:g} s") from None
        async with response:
            total = _prepare(source, part, response)
            if part.size != total:
                await _append(source, part, response, total)
    if not part.size:
        raise DownloadError(f"{source.url}: the server sent an empty file")


def can_resume(source: Source, part: Part) -> bool:
    """Tell whether bytes of two versions of the file, joined, would be noticed.

    Args:
        source: The file.
        part: What was received so far.

    Returns:
        True where there are bytes, and the server named their version or the hash is known.
    """
    return part.size > 0 and bool(source.sha256 or _known_version(source, part).validator)


def _known_version(source: Source, part: Part) -> Version:
    """Return the part's version where it is of the same address, else an unknown one."""
    return part.version if part.version.url == source.url else Version()


def _request_headers(source: Source, part: Part) -> dict[str, str]:
    headers = {"User-Agent": "xrgs", "Accept-Encoding": "identity"}
    if can_resume(source, part):
        headers["Range"] = f"bytes={part.size}-"
        if validator := _known_version(source, part).validator:
            headers["If-Range"] = validator
    return headers


async def _request(session: aiohttp.ClientSession, source: Source) -> aiohttp.ClientResponse:
    url = _parse(source, source.url)
    for _ in range(_MAX_REDIRECTS + 1):
        response = await session.get(url, allow_redirects=False)
        location = response.headers.get("Location")
        if response.status not in _REDIRECTS or location is None:
            return response
        response.close()
        url = _redirected(source, url, location)
    raise DownloadError(f"{source.url}: redirects more than {_MAX_REDIRECTS} times")


def _redirected(source: Source, url: URL, location: str) -> URL:
    """Return where a redirect leads, if it is the same host or one that the source admits."""
    target = url.join(_parse(source, location))
    words = f"{source.url}: redirects from {_host(url)} to {_words(str(target))}"
    if target.scheme not in ("http", "https") or (url.scheme, target.scheme) == ("https", "http"):
        raise DownloadError(f"{words}, which is not followed: it is less safe than {url.scheme}")
    if _host(target) not in (_host(url), *source.redirect_hosts):
        raise DownloadError(
            f"{words}, another host, which is not followed: give the file's address on "
            f"{_words(_host(target))} itself if you trust it"
        )
    return target


def _parse(source: Source, text: str) -> URL:
    try:
        return URL(text)
    except ValueError as error:
        raise DownloadError(f"{source.url}: {_words(text)!r} is not a valid address") from error


def _host(url: URL) -> str:
    """Return the host, with the port where it is not the scheme's own."""
    return f"{url.host}" if url.is_default_port() else f"{url.host}:{url.port}"


def _prepare(source: Source, part: Part, response: aiohttp.ClientResponse) -> int | None:
    """Check the answer's headers, and prepare the part for its body; return the file's size."""
    status, resumes = response.status, "Range" in response.request_info.headers
    if status == 200 or (status == 206 and resumes):
        _check_body(source, response)
        return (_begin if status == 200 else _resume)(source, part, response)
    if status == 416 and resumes:
        return _resume(source, part, response)
    words = f"the server says {status} {_words(response.reason or '')}".rstrip()
    if status == 429 or 500 <= status < 600:
        raise ConnectionLostError(words, _retry_after(response.headers))
    raise DownloadError(f"{source.url}: {words}")


def _check_body(source: Source, response: aiohttp.ClientResponse) -> None:
    if response.content_type.lower() in _WEB_PAGES:
        raise DownloadError(f"{source.url}: the server sent a web page, not the file")
    if len(response.headers.getall("Content-Length", [])) > 1:  # aiohttp's Python parser admits it
        raise DownloadError(f"{source.url}: the answer can't be used (several Content-Length)")
    for name, plain in (("Content-Encoding", "identity"), ("Transfer-Encoding", "chunked")):
        coding = response.headers.get(name, plain)
        if coding.lower() != plain:
            raise DownloadError(
                f"{source.url}: the server sent the file in another form than it has "
                f"({name}: {_words(coding)})"
            )


def _begin(source: Source, part: Part, response: aiohttp.ClientResponse) -> int | None:
    """Discard the part, since the answer has the whole file."""
    total = response.content_length
    if total is None and "Transfer-Encoding" not in response.headers and not source.sha256:
        raise DownloadError(
            f"{source.url}: the server does not say how long the file is, so that it can't be "
            "known whether all of it came; download it by other means"
        )
    _check_size(source, total or 0)
    part.begin(Version(source.url, _validator(response.headers), total))
    return total


def _resume(source: Source, part: Part, response: aiohttp.ClientResponse) -> int | None:
    """Check that the answer continues the part (206) or says that it is complete (416)."""
    first, last, total = _content_range(response.headers)
    known = _known_version(source, part)
    validators = {known.validator, _validator(response.headers)} - {""}
    is_same = known.total in (None, total) and len(validators) < 2
    if response.status == 416:
        fits = total == part.size
    else:
        fits = first == part.size <= last < total and response.content_length == last - first + 1
    if not (is_same and fits):
        part.begin(Version())
        raise ConnectionLostError("what was kept is not a part of the server's file; discarded")
    _check_size(source, total)
    part.joined = True
    return total


async def _append(
    source: Source, part: Part, response: aiohttp.ClientResponse, total: int | None
) -> None:
    try:
        with ProgressBar(part.target.name, "byte", total, done=part.size) as bar:
            while await _append_period(source, part, response, bar):
                pass
    except TimeoutError:
        raise ConnectionLostError(
            f"fewer than {LEAST_BYTES} bytes came in {_PERIOD_S:g} s"
        ) from None
    except aiohttp.ClientPayloadError:
        of = "" if total is None else f" of {total}"
        raise ConnectionLostError(f"the connection ended after {part.size}{of} bytes") from None
    if part.size < (total or 0):
        raise ConnectionLostError(f"the answer ended after {part.size} of {total} bytes")


async def _append_period(
    source: Source, part: Part, response: aiohttp.ClientResponse, bar: ProgressBar
) -> bool:
    """Append what comes until it is enough for one period; return whether there may be more."""
    enough = part.size + LEAST_BYTES
    async with asyncio.timeout(_PERIOD_S):
        while part.size < enough:
            chunk = await response.content.readany()
            if not chunk:
                return False
            _check_size(source, part.size + len(chunk))
            part.append(chunk)
            bar.update(len(chunk))
    return True


def _check_size(source: Source, size: int) -> None:
    if size > source.max_bytes:
        raise TooLargeError(
            f"{source.url}: {size} bytes or more, and at most {source.max_bytes} are allowed"
        )


def _content_range(headers: CIMultiDictProxy[str]) -> tuple[int, int, int]:
    """Return the first and last byte of a range and the file's size; 0 where they are not said."""
    ranges = headers.getall("Content-Range", [])
    match = _CONTENT_RANGE.fullmatch(ranges[0]) if len(ranges) == 1 else None
    if match is None:
        return 0, 0, 0
    first, last, total = (int(text or 0) for text in match.groups())
    return first, last, total


def _validator(headers: Mapping[str, str]) -> str:
    """Return what tells versions of the file apart, byte by byte; empty where nothing does.

    A weak ETag (`W/`) may stay while bytes change. A Last-Modified does so where the file changed
    twice in the second before the answer (RFC 9110, 8.8.2.2).
    """
    etag, modified = headers.get("ETag", ""), headers.get("Last-Modified", "")
    if _STRONG_ETAG.fullmatch(etag):
        return etag
    at, now = _seconds(modified), _seconds(headers.get("Date", ""))
    if at is None or now is None or now - at < 1:
        return ""
    return modified if modified.isascii() and modified.isprintable() else ""


def _retry_after(headers: CIMultiDictProxy[str]) -> float:
    """Return the seconds to wait that the server asks for, as a number or as a date."""
    text = headers.get("Retry-After", "")
    if re.fullmatch(r"\d{1,9}", text):
        return float(text)
    until, now = _seconds(text), _seconds(headers.get("Date", ""))
    return 0.0 if until is None or now is None else max(0.0, until - now)


def _seconds(date: str) -> float | None:
    """Return the POSIX time of a date in a header; None where it is not a date."""
    try:
        parsed = parsedate_tz(date)
        return None if parsed is None else float(mktime_tz(parsed))
    except (ValueError, TypeError, OverflowError):
        return None


def _words(text: str) -> str:
    """Return words that a server may have chosen, short enough for a message, on one line."""
    line = for_line(text)
    return line if len(line) <= _MAX_WORDS else f"{line[:_MAX_WORDS]}..."
