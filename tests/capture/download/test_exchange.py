"""Answers of servers that are malformed, hostile, endless, slow, or lead elsewhere.

Each ends in the right file, or in one line that names the address; never in a wrong file.
"""

from __future__ import annotations

import gzip
import hashlib
import itertools
import random
import socket
import struct
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

import pytest
from yarl import URL

from xrgs.capture.download import exchange
from xrgs.capture.download.exchange import TooLargeError
from xrgs.capture.download.http import download
from xrgs.capture.download.part import DownloadError

CONTENT = random.Random(0).randbytes(200_000)
OTHER = random.Random(1).randbytes(200_000)
SHA256 = hashlib.sha256(CONTENT).hexdigest()
ESCAPES = "\x1b[31mred\x1b[0m\x07"
MOST = 1_000_000


#: What is sent in turn; `RESET` ends the connection by a reset.
Answer = Iterable[bytes]
RESET = b"reset"


def answer(body: bytes = b"", status: str = "200 OK", **headers: str | list[str]) -> list[bytes]:
    """The bytes of an answer; underscores in names of headers stand for hyphens.

    The headers have the length of the body unless `Content_Length=[]` or chunks are given.
    """
    given: dict[str, str | list[str]] = {
        "Content-Type": "application/zip",
        "Connection": "close",
    }
    if "Transfer_Encoding" not in headers:
        given["Content-Length"] = str(len(body))
    given |= {name.replace("_", "-"): value for name, value in headers.items()}
    lines = [f"HTTP/1.1 {status}"]
    for name, value in given.items():
        lines += [f"{name}: {one}" for one in ([value] if isinstance(value, str) else value)]
    return ["\r\n".join([*lines, "", ""]).encode("latin-1"), body]


CHUNKED_HEAD = answer(Transfer_Encoding="chunked")[0]


@dataclass
class Rogue:
    """The state of the server: the answers to come, and the requests so far."""

    answers: list[Answer | Callable[[dict[str, str]], Answer]] = field(default_factory=list)
    """The answers to the requests in turn, or functions of the request's headers that return one;
    the last one answers all further requests."""
    requests: list[dict[str, str]] = field(default_factory=list)
    """The headers of each request so far by their lower-case names, and the path as `path`."""
    url: str = ""

    def serve(self, listening: socket.socket) -> None:
        """Answer one request of each connection, each in a thread, until the socket is closed."""
        while True:
            try:
                connection, _ = listening.accept()
            except OSError:
                return
            threading.Thread(target=self._answer, args=(connection,), daemon=True).start()

    def _answer(self, connection: socket.socket) -> None:
        with connection, suppress(OSError):  # the client may close the connection first
            first, *lines = _read_head(connection).decode("latin-1").split("\r\n")
            request = {name.lower(): value for name, _, value in (x.partition(": ") for x in lines)}
            self.requests.append(request | {"path": first.split(" ")[1]})
            number = min(len(self.requests), len(self.answers)) - 1
            planned = self.answers[number]
            for content in planned(request) if callable(planned) else planned:
                if content == RESET:
                    linger = struct.pack("ii", 1, 0)  # closing then discards what was not sent
                    connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, linger)
                    return
                connection.sendall(content)
            connection.shutdown(socket.SHUT_WR)
            connection.recv(1)  # until the client closes: closing first could reset what was sent


def _read_head(connection: socket.socket) -> bytes:
    head = b""
    while b"\r\n\r\n" not in head:
        received = connection.recv(1 << 16)
        if not received:
            raise ConnectionError
        head += received
    return head


@pytest.fixture
def rogue(pauses: list[float]) -> Iterator[Rogue]:
    """Start such a server on the loopback interface; return its state."""
    state = Rogue()
    with socket.create_server(("127.0.0.1", 0)) as listening:
        state.url = f"http://127.0.0.1:{listening.getsockname()[1]}/scenes.zip"
        thread = threading.Thread(target=state.serve, args=(listening,))
        thread.start()
        yield state
        listening.shutdown(socket.SHUT_RDWR)
    thread.join()


@pytest.fixture
def target(tmp_path: Path) -> Path:
    return tmp_path / "scenes.zip"


def keep(target: Path, content: bytes) -> None:
    """Leave a part behind, as an earlier process would have."""
    target.with_name("scenes.zip.part").write_bytes(content)


def cut(body: bytes, length: int, **headers: str | list[str]) -> Answer:
    """The answer with the body, of which only the first bytes are sent."""
    head, _ = answer(body, "200 OK", **headers)
    return [head, body[:length]]


def ranged(body: bytes, honest: bool = True, **headers: str) -> Callable[[dict[str, str]], Answer]:
    """A server of ranges; one that is not honest ignores If-Range."""

    def respond(request: dict[str, str]) -> Answer:
        is_same = request.get("if-range") in (None, headers.get("ETag"))
        if "range" not in request or (honest and not is_same):
            return answer(body, **headers)
        start = int(request["range"].removeprefix("bytes=").removesuffix("-"))
        span = f"bytes {start}-{len(body) - 1}/{len(body)}"
        return answer(body[start:], "206 Partial Content", Content_Range=span, **headers)

    return respond


def chunk(content: bytes) -> bytes:
    return b"%x\r\n%b\r\n" % (len(content), content)


def refusal(rogue: Rogue, target: Path, sha256: str = "") -> str:
    """Download, and return the message of the error; check that it is one line for a user."""
    with pytest.raises(DownloadError) as caught:
        download(rogue.url, target, MOST, sha256)
    message = str(caught.value)
    assert message.startswith(rogue.url)
    assert message.isprintable()
    assert len(message) < 500
    assert not target.exists()
    return message


@pytest.mark.parametrize("honest", [True, False], ids=["If-Range", "ignores If-Range"])
def test_a_file_that_changed_is_downloaded_again(rogue: Rogue, target: Path, honest: bool) -> None:
    first = cut(CONTENT, 80_000, ETag='"a"')
    rogue.answers = [first, ranged(OTHER, honest, ETag='"b"')]
    download(rogue.url, target, MOST)
    assert target.read_bytes() == OTHER
    assert rogue.requests[1]["if-range"] == '"a"'


def test_a_file_that_changed_its_length_is_downloaded_again(rogue: Rogue, target: Path) -> None:
    changed = ranged(OTHER + b"more", honest=False)
    rogue.answers = [cut(CONTENT, 80_000, ETag='"a"'), changed]
    download(rogue.url, target, MOST)
    assert target.read_bytes() == OTHER + b"more"


@pytest.mark.parametrize(
    ("headers", "sent"),
    [
        ({"ETag": '"a"'}, '"a"'),
        ({"ETag": 'W/"a"'}, None),
        ({"ETag": '"a\x1b"'}, None),
        ({"ETag": "a"}, None),
        ({}, None),
        ({"Last_Modified": "Wed, 01 Jan 2020 10:00:00 GMT"}, None),
        (
            {
                "Last_Modified": "Wed, 01 Jan 2020 10:00:00 GMT",
                "Date": "Wed, 01 Jan 2020 10:00:00 GMT",
            },
            None,
        ),
        (
            {
                "Last_Modified": "Wed, 01 Jan 2020 10:00:00 GMT",
                "Date": "Wed, 01 Jan 2020 10:00:01 GMT",
            },
            "Wed, 01 Jan 2020 10:00:00 GMT",
        ),
        (
            {
                "ETag": 'W/"a"',
                "Last_Modified": "Wed, 01 Jan 2020 10:00:00 GMT",
                "Date": "Thu, 02 Jan 2020 10:00:00 GMT",
            },
            "Wed, 01 Jan 2020 10:00:00 GMT",
        ),
        ({"Last_Modified": "yesterday", "Date": "Wed, 01 Jan 99999 10:00:00 GMT"}, None),
    ],
    ids=str,
)
def test_only_a_validator_that_tells_every_byte_lets_a_part_be_continued(
    rogue: Rogue, target: Path, headers: dict[str, str], sent: str | None
) -> None:
    rogue.answers = [cut(CONTENT, 80_000, **headers), answer(CONTENT)]
    download(rogue.url, target, MOST)
    assert target.read_bytes() == CONTENT
    assert rogue.requests[1].get("if-range") == sent
    assert rogue.requests[1].get("range") == (None if sent is None else "bytes=80000-")


@pytest.mark.parametrize(
    "headers",
    [
        {"Content_Range": []},
        {"Content_Range": "nonsense"},
        {"Content_Range": "bytes 5-"},
        {"Content_Range": "bytes 1005-199999/200000"},
        {"Content_Range": "bytes 1000-500/200000"},
        {"Content_Range": "bytes 1000-199999/5"},
        {"Content_Range": "bytes 1000-199999/150000"},
        {"Content_Range": "bytes 1000-199999/*"},
        {"Content_Range": f"bytes 1000-199999/{'9' * 30}"},
        {"Content_Range": "items 1000-199999/200000"},
        {"Content_Range": ["bytes 1000-199999/200000", "bytes 1000-199999/300000"]},
        {"Content_Range": "bytes 1000-199998/200000"},
    ],
    ids=lambda headers: str(headers["Content_Range"])[:60],
)
def test_a_range_that_does_not_continue_the_part_is_not_appended(
    rogue: Rogue, target: Path, headers: dict[str, str]
) -> None:
    keep(target, CONTENT[:1000])
    partial = answer(CONTENT[1000:], "206 Partial Content", **headers)
    rogue.answers = [partial, answer(CONTENT)]
    download(rogue.url, target, MOST, SHA256)
    assert target.read_bytes() == CONTENT
    assert rogue.requests[0]["range"] == "bytes=1000-"
    assert "range" not in rogue.requests[1]


def test_a_range_of_chunks_is_not_appended(rogue: Rogue, target: Path) -> None:
    keep(target, CONTENT[:1000])
    span = f"bytes 1000-{len(CONTENT) - 1}/{len(CONTENT)}"
    head, _ = answer(status="206 Partial Content", Content_Range=span, Transfer_Encoding="chunked")
    rogue.answers = [[head, chunk(CONTENT[1000:] + b"more"), b"0\r\n\r\n"], answer(CONTENT)]
    download(rogue.url, target, MOST, SHA256)
    assert target.read_bytes() == CONTENT


def test_a_range_in_pieces_is_joined(rogue: Rogue, target: Path) -> None:
    keep(target, CONTENT[:1000])

    def piece(request: dict[str, str]) -> Answer:
        start = int(request["range"].removeprefix("bytes=").removesuffix("-"))
        body = CONTENT[start : start + 70_000]
        span = f"bytes {start}-{start + len(body) - 1}/{len(CONTENT)}"
        return answer(body, "206 Partial Content", Content_Range=span)

    rogue.answers = [piece]
    download(rogue.url, target, MOST, SHA256)
    assert target.read_bytes() == CONTENT
    assert len(rogue.requests) == 3


@pytest.mark.parametrize(
    "length",
    ["99x", "-5", "9" * 30, "", "1e5", "+200000", "0x10", "200000, 100000", ["200000", "100000"]],
    ids=lambda length: repr(length)[:40],
)
def test_a_malformed_length_is_refused(rogue: Rogue, target: Path, length: str | list[str]) -> None:
    rogue.answers = [answer(CONTENT, Content_Length=length)]
    message = refusal(rogue, target)
    assert "the answer can't be used (" in message or f"at most {MOST} are allowed" in message
    assert len(rogue.requests) == 1


@pytest.mark.parametrize(
    "content",
    [
        chunk(CONTENT)[:100_000],
        chunk(CONTENT),
        b"",
        chunk(CONTENT) + b"0\r\n",
    ],
    ids=["in a chunk", "between chunks", "before the first", "before the last line"],
)
def test_chunks_that_end_early_are_no_file(rogue: Rogue, target: Path, content: bytes) -> None:
    rogue.answers = [[CHUNKED_HEAD, content]]
    assert "the connection ended after" in refusal(rogue, target)


@pytest.mark.parametrize("size", [b"zz", b"-5", b"f" * 40, b"5 5"])
def test_a_malformed_chunk_is_refused(
    rogue: Rogue, target: Path, monkeypatch: pytest.MonkeyPatch, size: bytes
) -> None:
    # Where the chunk comes later than the headers, aiohttp reports nothing, as if it had not come.
    monkeypatch.setattr(exchange, "_PERIOD_S", 0.2)
    rogue.answers = [[CHUNKED_HEAD, size + b"\r\nhello\r\n0\r\n\r\n"]]
    refusal(rogue, target)


def test_chunks_are_a_file(rogue: Rogue, target: Path) -> None:
    rogue.answers = [[CHUNKED_HEAD, chunk(CONTENT[:5]), chunk(CONTENT[5:]), b"0\r\n\r\n"]]
    download(rogue.url, target, MOST)
    assert target.read_bytes() == CONTENT


@pytest.mark.parametrize(
    ("sent", "why"),
    [
        (answer(gzip.compress(CONTENT), Content_Encoding="gzip"), "Content-Encoding: gzip"),
        (answer(CONTENT, Content_Encoding=f"x{ESCAPES}"), "Content-Encoding"),
        (
            [answer(Transfer_Encoding="gzip, chunked")[0], chunk(CONTENT), b"0\r\n\r\n"],
            "Transfer-Encoding: gzip, chunked",
        ),
        (answer(b"<html>", Content_Type="TEXT/HTML; charset=utf-8"), "a web page"),
        (answer(b"<html>", Content_Type="application/xhtml+xml"), "a web page"),
        (answer(b""), "an empty file"),
        ([CHUNKED_HEAD, b"0\r\n\r\n"], "an empty file"),
        (answer(CONTENT, Content_Length=[]), "how long the file is"),
        (answer(CONTENT, "206 Partial", Content_Range="bytes 0-199999/200000"), "says 206"),
        (answer(b"", "416 No", Content_Range="bytes */0"), "says 416"),
        (answer(b"", "204 No Content"), "says 204"),
        (answer(b"", "304 Not Modified"), "says 304"),
        (answer(b"", f"404 {ESCAPES}"), r"says 404 "),
        (answer(b"", f"999 {ESCAPES}"), r"says 999 "),
        (answer(b"", f"404 {'x' * 8000}"), "says 404 xxx"),
        (answer(b"", f"404 {'x' * 80_000}"), "can't be used"),
        ([f"HTTP/1.1 200 OK\r\nX{ESCAPES}: 1\r\n\r\n".encode()], "can't be used"),
        ([f"{ESCAPES} nonsense\r\n\r\n".encode()], "can't be used"),
        ([CONTENT], "can't be used"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_what_is_not_the_file_is_refused_at_once(
    rogue: Rogue, target: Path, sent: Answer, why: str
) -> None:
    rogue.answers = [sent]
    assert why in refusal(rogue, target)
    assert len(rogue.requests) == 1


def test_a_body_of_unknown_length_is_taken_where_its_hash_is_known(
    rogue: Rogue, target: Path
) -> None:
    rogue.answers = [answer(CONTENT, Content_Length=[])]
    download(rogue.url, target, MOST, SHA256)
    assert target.read_bytes() == CONTENT


@pytest.mark.parametrize(
    "head",
    [b"", b"HTTP/1.1 200 O", answer(CONTENT)[0], answer(CONTENT)[0] + CONTENT[:80_000]],
    ids=["before the answer", "in the headers", "before the body", "in the body"],
)
@pytest.mark.parametrize("end", [[], [RESET]], ids=["closed", "reset"])
def test_a_connection_that_ends_early_is_tried_again(
    rogue: Rogue, target: Path, head: bytes, end: list[bytes]
) -> None:
    rogue.answers = [[head, *end], answer(CONTENT)]
    download(rogue.url, target, MOST)
    assert target.read_bytes() == CONTENT
    assert len(rogue.requests) == 2


def drip(head: bytes, drop: bytes = b"x") -> Iterator[bytes]:
    """Send a byte every 20 ms, which keeps any limit on silence alone from being reached."""
    yield head
    pause = threading.Event()
    while not pause.wait(0.02):
        yield drop


SLOW = {
    "status": b"HTTP/1.1 200 ",
    "headers": b"HTTP/1.1 200 OK\r\nX: ",
    "body": answer(CONTENT)[0],
    "chunk size": CHUNKED_HEAD + b"5;",
    "trailers": CHUNKED_HEAD + chunk(b"hello") + b"0\r\nX: ",
}


@pytest.mark.parametrize("head", SLOW.values(), ids=SLOW)
def test_a_drip_is_given_up(
    rogue: Rogue, target: Path, monkeypatch: pytest.MonkeyPatch, head: bytes
) -> None:
    monkeypatch.setattr(exchange, "_ANSWER_S", 0.2)
    monkeypatch.setattr(exchange, "_PERIOD_S", 0.2)
    rogue.answers = [lambda _: drip(head)]
    message = refusal(rogue, target)
    assert "no complete answer in 0.2 s" in message or "fewer than 60000 bytes" in message


def test_a_server_without_an_answer_is_given_up(
    rogue: Rogue, target: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(exchange, "_ANSWER_S", 0.1)
    rogue.answers = [lambda _: itertools.islice(drip(b"", b""), 100)]
    assert "no complete answer in 0.1 s" in refusal(rogue, target)


FLOODS = {
    "header lines": (b"HTTP/1.1 200 OK\r\n", b"X: y\r\n" * 100),
    "a header": (b"HTTP/1.1 200 OK\r\nX: ", b"x" * 10_000),
    "a status": (b"HTTP/1.1 200 ", b"x" * 10_000),
    "trailers": (CHUNKED_HEAD + chunk(b"hello") + b"0\r\n", b"X: y\r\n" * 100),
    "a chunk size": (CHUNKED_HEAD, b"1" * 10_000),
    "a chunk extension": (CHUNKED_HEAD + b"5;", b"x" * 10_000),
    "informational answers": (b"", b"HTTP/1.1 100 Continue\r\n\r\n" * 100),
}


@pytest.mark.parametrize(("head", "block"), FLOODS.values(), ids=FLOODS)
def test_a_flood_outside_of_the_body_is_given_up(
    rogue: Rogue, target: Path, monkeypatch: pytest.MonkeyPatch, head: bytes, block: bytes
) -> None:
    monkeypatch.setattr(exchange, "_ANSWER_S", 0.2)
    monkeypatch.setattr(exchange, "_PERIOD_S", 0.2)
    rogue.answers = [lambda _: itertools.chain([head], itertools.repeat(block))]
    refusal(rogue, target)


@pytest.mark.parametrize(
    ("head", "block"),
    [
        (answer(Content_Length=[])[0], bytes(10_000)),
        (CHUNKED_HEAD, chunk(bytes(10_000))),
        (answer(Content_Length=str(10**12))[0], bytes(10_000)),
    ],
    ids=["to the end of the connection", "in chunks", "announced"],
)
def test_an_endless_body_is_cut_at_the_largest_size(
    rogue: Rogue, target: Path, head: bytes, block: bytes
) -> None:
    rogue.answers = [lambda _: itertools.chain([head], itertools.repeat(block))]
    with pytest.raises(TooLargeError, match=f"at most {MOST} are allowed"):
        download(rogue.url, target, MOST, SHA256)
    assert target.with_name("scenes.zip.part").stat().st_size <= MOST
    assert not target.exists()


def test_redirects_on_one_host_are_followed(rogue: Rogue, target: Path) -> None:
    rogue.answers = [answer(b"", "302 Found", Location="/moved?x=y#z"), answer(CONTENT)]
    download(rogue.url, target, MOST)
    assert target.read_bytes() == CONTENT
    assert rogue.requests[1]["path"] == "/moved?x=y"


def test_five_redirects_are_followed_and_no_more(rogue: Rogue, target: Path) -> None:
    rogue.answers = [*[answer(b"", "302 Found", Location="/next")] * 5, answer(CONTENT)]
    download(rogue.url, target, MOST)
    target.unlink()
    rogue.answers = [answer(b"", "302 Found", Location="/next")]
    rogue.requests.clear()
    assert "redirects more than 5 times" in refusal(rogue, target)
    assert len(rogue.requests) == 6


def test_another_host_is_not_asked_unless_it_is_admitted(rogue: Rogue, target: Path) -> None:
    port = rogue.url.rpartition(":")[2].partition("/")[0]
    elsewhere = answer(b"", "302 Found", Location=f"http://localhost:{port}/x")
    rogue.answers = [elsewhere, answer(CONTENT)]
    message = refusal(rogue, target)
    assert f"127.0.0.1:{port}" in message
    assert f"localhost:{port}" in message
    assert len(rogue.requests) == 1
    rogue.requests.clear()
    download(rogue.url, target, MOST, redirect_hosts=[f"localhost:{port}"])
    assert target.read_bytes() == CONTENT


@pytest.mark.parametrize(
    ("url", "location", "to"),
    [
        ("http://a.org/x", "http://b.org/y", None),
        ("http://a.org/x", "http://a.org:81/y", None),
        ("http://a.org:80/x", "//a.org/y", "http://a.org/y"),
        ("http://a.org/x", "http:///y", "http://a.org/y"),
        ("http://a.org/x", "https://a.org/y", "https://a.org/y"),
        ("http://a.org/x", "http://A.ORG/y", "http://a.org/y"),
        ("http://a.org/x", "http://c.org/y", "http://c.org/y"),
        ("https://a.org/x", "https://c.org/y", "https://c.org/y"),
        ("https://a.org/x", "http://a.org/y", None),
        ("https://a.org/x", "http://c.org/y", None),
        ("http://a.org/x", "http://a.org@b.org/y", None),
        ("http://a.org/x", "http://b.org\\@a.org/y", None),
        ("http://a.org/x", "http://a.org.b.org/y", None),
        ("http://a.org/x", "file:///etc/hostname", None),
        ("http://a.org/x", "ftp://a.org/y", None),
        ("http://a.org/x", "javascript:1", None),
        ("http://a.org/x", "http://[::1/y", None),
        ("http://a.org/x", f"http://{ESCAPES}/y", None),
        ("http://a.org/x", f"http://{'b' * 5000}.org/y", None),
    ],
)
def test_where_a_redirect_may_lead(url: str, location: str, to: str | None) -> None:
    source = exchange.Source(url, MOST, redirect_hosts=("c.org",))
    if to is not None:
        assert str(exchange._redirected(source, URL(url), location)) == to
        return
    with pytest.raises(DownloadError) as caught:
        exchange._redirected(source, URL(url), location)
    assert str(caught.value).isprintable()
    assert str(caught.value).startswith(url)
    assert len(str(caught.value)) < 500


def test_a_redirect_to_nowhere_is_refused(rogue: Rogue, target: Path) -> None:
    rogue.answers = [answer(b"", "302 Found")]
    assert "302" in refusal(rogue, target)
