"""Downloads a file from a web server: resumes, tries again, and verifies the result."""

from __future__ import annotations

import random
import time
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

from xrgs.capture.download.exchange import (
    LEAST_BYTES,
    ConnectionLostError,
    Source,
    can_resume,
    receive,
)
from xrgs.capture.download.part import DownloadError, Version, open_part
from xrgs.runtime.progress import log_line

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

    from xrgs.capture.download.part import Part

#: Attempts in succession that bring fewer than LEAST_BYTES before a download is given up.
_ATTEMPTS = 6
#: Seconds before the second attempt, doubled for each further one, and the longest pause.
_PAUSE_S, _MAX_PAUSE_S = 1.0, 30.0
#: The longest pause, in seconds, that a server can ask for.
_MAX_RETRY_AFTER_S = 120.0


def is_url(text: str) -> bool:
    """Tell whether a text is an address that `download` can read.

    Args:
        text: Any text.

    Returns:
        True for http and https addresses.
    """
    try:
        return urlsplit(text).scheme in ("http", "https")
    except ValueError:
        return False


def download(
    url: str, target: Path, max_bytes: int, sha256: str = "", redirect_hosts: Iterable[str] = ()
) -> None:
    """Download a file; what an interrupted download received is kept in `<target>.part`.

    A part is continued where the server says that its file is the same as before, or where the
    result has a hash to verify; else the download begins again. An attempt that fails for a reason
    that may pass is repeated after a growing pause, for as long as attempts bring something.

    Args:
        url: An http or https address.
        target: The file to write; its folder is made. Only a complete file ever has this name.
        max_bytes: The largest size that is accepted, whatever the server announces or sends.
        sha256: The expected SHA-256, in hexadecimal; empty to verify nothing.
        redirect_hosts: Hosts besides the address's own to which the server may redirect, with a
            port where it is not the usual one.

    Raises:
        TooLargeError: The file is larger than `max_bytes`; what was received is kept, for a call
            with a larger one.
        DownloadError: The server is unreachable, refuses, is too slow, redirects to another host
            or sends something else; the content has another hash; or the disk can't take it.
    """
    if not is_url(url):
        raise DownloadError(f"{url or 'an empty address'}: only http and https are read")
    source = Source(url, max_bytes, sha256.lower(), tuple(redirect_hosts))
    try:
        with open_part(target) as part:
            _receive_verified(source, part)
            part.complete()
    except OSError as error:
        raise DownloadError(f"{target}.part: {error.strerror or error}") from error


def _receive_verified(source: Source, part: Part) -> None:
    """Receive all of the file; where a joined one has another hash, receive it once more."""
    for is_last in (False, True):
        _receive_all(source, part)
        if not source.sha256 or (actual := part.digest()) == source.sha256:
            return
        if is_last or not part.joined:
            break
        log_line(f"{source.url}: its joined parts have another sha256; downloaded once more")
        part.begin(Version())
    part.remove()
    raise DownloadError(
        f"{source.url}: sha256 is {actual}, expected {source.sha256}; it was not kept"
    )


def _receive_all(source: Source, part: Part) -> None:
    """Receive until the file is complete, or attempts bring nothing any more."""
    most, fruitless = part.size, 0
    while True:
        try:
            return receive(source, part)
        except ConnectionLostError as lost:
            # Measured by the most so far: a server may begin again for ever.
            fruitless = 0 if part.size >= most + LEAST_BYTES else fruitless + 1
            most = max(most, part.size)
            if fruitless == _ATTEMPTS:
                words = f"{source.url}: can't be downloaded ({lost}) to {part.target}"
                if can_resume(source, part):
                    words += f"; {part.size} bytes are kept for the next attempt"
                raise DownloadError(words) from lost
            pause = _pause(fruitless, lost.retry_after)
            log_line(f"{source.url}: {lost}; tried again in {pause:.1f} s")
            _wait(pause)


def _pause(fruitless: int, retry_after: float) -> float:
    """Return the seconds to wait, at random so that many clients don't come back together."""
    longest = min(_MAX_PAUSE_S, _PAUSE_S * 2 ** max(0, fruitless - 1))
    return max(random.uniform(longest / 2, longest), min(retry_after, _MAX_RETRY_AFTER_S))  # noqa: S311


def _wait(seconds: float) -> None:
    time.sleep(seconds)
