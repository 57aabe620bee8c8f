"""Downloads a file from a web server: resumes it, tries again, and verifies the result."""

from __future__ import annotations

import fcntl
import http.client
import os
import re
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from time import monotonic, sleep
from typing import IO, Any
from urllib.error import HTTPError
from urllib.parse import urlsplit
from urllib.request import HTTPRedirectHandler, Request, build_opener

from xrgs.errors import XrgsError
from xrgs.runtime.progress import ProgressBar, log_line
from xrgs.safeio.atomic import write_text
from xrgs.safeio.hashing import file_digest
from xrgs.safeio.sanitize import for_line

#: A download is given up after this many successive tries with fewer than _LEAST_BYTES each.
_TRIES = 6
#: Seconds before the second try; each further pause is twice as long.
_PAUSE_S = 1.0
#: The slowest rate: a server must send this many bytes in each period of this many seconds.
_LEAST_BYTES, _PERIOD_S = 60_000, 60.0
_CHUNK = 1 << 16  # bytes
#: The most characters of a server's own words in a message.
_MAX_WORDS = 120


class DownloadError(XrgsError):
    """A file can't be downloaded; the message names the address or the file."""


class NotAllowedError(DownloadError):
    """The server sends more bytes than the caller allows, or redirects to another host."""


class _LostError(Exception):
    """This try failed, and another one may succeed."""


def is_url(text: str) -> bool:
    """Tell whether a text is an http or https address."""
    return re.match(r"https?://[^/?#]", text, re.IGNORECASE) is not None


def download(
    url: str, target: Path, max_bytes: int, sha256: str = "", redirect_hosts: Iterable[str] = ()
) -> None:
    """Download a file; an interrupted download keeps its bytes in `<target>.part`.

    The next call continues that part if the server's file is still the same, else it begins again.
    A try that fails for a reason that may pass is repeated after a growing pause. Only a complete
    file ever has the name `target`, whose folder is made.

    Args:
        url: An http or https address.
        target: The file to write.
        max_bytes: The largest accepted size.
        sha256: The expected SHA-256, in hexadecimal; empty to verify nothing.
        redirect_hosts: Further hosts to which the server may redirect, each with its port if
            the address has one.

    Raises:
        DownloadError: The file exists or can't be written; the server is unreachable, refuses, is
            too slow, redirects to another host, or sends a web page or more than `max_bytes`; or
            the hash differs.
    """
    if not is_url(url):
        raise DownloadError(f"{url or 'an empty address'}: must begin with http:// or https://")
    part = target.with_name(f"{target.name}.part")
    version = target.with_name(f"{target.name}.part.version")
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        with part.open("ab") as stream:
            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)  # one process appends
            if target.exists():  # another process may have renamed the part since it was opened
                raise DownloadError(f"{target}: there already")
            _Download(url, stream, version, max_bytes, redirect_hosts).run()
            stream.flush()
            os.fsync(stream.fileno())
            if sha256 and (actual := file_digest(part)) != sha256.lower():
                part.unlink()
                version.unlink()
                raise DownloadError(f"{url}: sha256 is {actual}, expected {sha256}; not kept")
            part.rename(target)
            version.unlink()
    except BlockingIOError as error:
        raise DownloadError(f"{target}: another process is downloading it") from error
    except OSError as error:
        raise DownloadError(f"{part}: can't be written ({error.strerror or error})") from error


class _Download:
    """Requests the missing bytes of a file and appends them to a stream."""

    def __init__(
        self, url: str, stream: IO[bytes], version: Path, max_bytes: int, hosts: Iterable[str]
    ) -> None:
        self._url, self._stream, self._version, self._max_bytes = url, stream, version, max_bytes
        self._opener = build_opener(_RedirectHandler(url, hosts))

    @property
    def _size(self) -> int:
        return self._stream.tell()

    def run(self) -> None:
        """Receive until the file is complete, or until _TRIES tries in succession bring nothing."""
        most, failures = self._size, 0
        while True:
            try:
                return self._receive()
            except _LostError as lost:
                # A server without ranges begins at 0 each time: a try must pass all before it.
                failures = 0 if self._size >= most + _LEAST_BYTES else failures + 1
                most = max(most, self._size)
                if failures == _TRIES:
                    so_far = f"; {self._stream.name} has {self._size} bytes" * (self._size > 0)
                    raise DownloadError(
                        f"{self._url}: can't be downloaded ({lost}){so_far}"
                    ) from lost
                pause = _PAUSE_S * 2 ** max(0, failures - 1)
                log_line(f"{self._url}: {lost}; trying again in {pause:g} s")
                sleep(pause)

    def _receive(self) -> None:
        headers = {"User-Agent": "xrgs"}
        known = self._version.read_text() if self._size and self._version.exists() else ""
        address, _, validator = known.partition("\n")
        if address == self._url and validator:
            headers |= {"Range": f"bytes={self._size}-", "If-Range": validator}
        with self._network():
            request = Request(self._url, headers=headers)  # noqa: S310  `download` admits http only
            response = self._opener.open(request, timeout=_PERIOD_S)
        with response:
            self._append(response, self._prepare(response, validator))

    @contextmanager
    def _network(self) -> Iterator[None]:
        """Turn errors of the network into `_LostError` if another try may succeed."""
        try:
            yield
        except HTTPError as error:
            words = f"the server says {error.code} {for_line(error.reason, _MAX_WORDS)}"
            error.close()
            if error.code == 416:  # range not satisfiable: the file ends before it
                self._begin("")
            elif error.code != 429 and error.code < 500:
                raise DownloadError(f"{self._url}: {words}") from error
            raise _LostError(words) from error
        except (http.client.InvalidURL, ValueError) as error:
            raise DownloadError(f"{self._url}: not a valid address ({error})") from error
        except (http.client.HTTPException, OSError) as error:
            reason = getattr(error, "reason", error)  # urllib's URLError wraps another error
            why = getattr(reason, "strerror", None) or str(reason)
            raise _LostError(for_line(why, _MAX_WORDS)) from error

    def _begin(self, validator: str) -> None:
        """Discard all bytes, and store the validator (ETag or date) of those that follow."""
        self._stream.seek(0)
        self._stream.truncate()  # first: no bytes may ever stand beside another version's validator
        write_text(self._version, f"{self._url}\n{validator}")

    def _prepare(self, response: http.client.HTTPResponse, known: str) -> int | None:
        """Check the headers of an answer, and discard the part unless the answer continues it.

        Returns:
            The file's size in bytes; None if the server did not send it.
        """
        headers = response.headers
        if headers.get_content_type() in ("text/html", "application/xhtml+xml"):
            raise DownloadError(f"{self._url}: the server sent a web page, not the file")
        # A weak ETag (W/"...") may stay the same while bytes change.
        etag = headers.get("ETag", "")
        validator = etag if etag.startswith('"') else headers.get("Last-Modified", "")
        if response.status != 206:
            self._begin(validator)
            total: int | None = response.length
        else:
            span = re.match(rf"bytes {self._size}-\d+/(\d+)$", headers.get("Content-Range", ""))
            if span is None or not self._size or validator not in ("", known):
                self._begin("")
                raise _LostError("the answer does not continue the part, which was discarded")
            total = int(span[1])
        self._check_size(total or 0)
        return total

    def _append(self, response: http.client.HTTPResponse, total: int | None) -> None:
        with ProgressBar(Path(self._stream.name).stem, "byte", total, done=self._size) as bar:
            since, before = monotonic(), self._size
            while chunk := self._read(response):
                self._check_size(self._size + len(chunk))
                self._stream.write(chunk)
                bar.update(len(chunk))
                if monotonic() - since > _PERIOD_S:
                    if self._size - before < _LEAST_BYTES:
                        raise _LostError(f"fewer than {_LEAST_BYTES} bytes in {_PERIOD_S:g} s")
                    since, before = monotonic(), self._size
        # http.client accepts headers that are cut off; then no bytes follow.
        if self._size == 0 or total not in (None, self._size):
            of = "" if total is None else f" of {total}"
            raise _LostError(f"the connection ended after {self._size}{of} bytes")

    def _read(self, response: http.client.HTTPResponse) -> bytes:
        with self._network():
            return response.read1(_CHUNK)  # `read` would wait for a whole chunk, however slow

    def _check_size(self, size: int) -> None:
        if size > self._max_bytes:
            most = f"at most {self._max_bytes} are allowed"
            raise NotAllowedError(f"{self._url}: {size} bytes or more; {most}")


class _RedirectHandler(HTTPRedirectHandler):
    """Follows redirects on one host and to the hosts that the caller admits."""

    max_redirections = 5

    def __init__(self, url: str, hosts: Iterable[str]) -> None:
        self._url, self._hosts = url, tuple(hosts)

    def redirect_request(
        self, req: Request, fp: IO[bytes], code: int, msg: str, headers: Any, newurl: str
    ) -> Request | None:
        """Return the request that follows a redirect; urllib calls this."""
        target = urlsplit(newurl)
        is_safe = target.scheme in ("https", urlsplit(req.full_url).scheme)
        hosts = [host.lower() for host in (urlsplit(self._url).netloc, *self._hosts)]
        if not is_safe or target.netloc.lower() not in hosts:
            why = "another host" if is_safe else "less safe"
            where = for_line(newurl, _MAX_WORDS)
            fp.close()
            raise NotAllowedError(f"{self._url}: the redirect to {where} is not followed ({why})")
        return super().redirect_request(req, fp, code, msg, headers, newurl)
