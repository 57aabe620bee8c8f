"""Downloads that are resumed, tried again and verified, from a server that cuts and refuses."""

from __future__ import annotations

import fcntl
import hashlib
import io
import random
from pathlib import Path
from typing import Any
from urllib.request import Request

import pytest

from xrgs.photos.download import http
from xrgs.photos.download.http import DownloadError, download

CONTENT = random.Random(0).randbytes(700_000)
#: The largest size that is accepted: exactly the content's.
MOST = len(CONTENT)
SHA256 = hashlib.sha256(CONTENT).hexdigest()


@pytest.fixture
def target(tmp_path: Path) -> Path:
    return tmp_path / "made" / "scenes.zip"


@pytest.fixture
def part(server: Any, target: Path) -> Path:
    """The first 300,000 bytes, as an interrupted download leaves them."""
    server.content, server.cuts = CONTENT, [300_000] + [0] * http._TRIES
    with pytest.raises(DownloadError, match=r"ended after 300000 of 700000.*zip\.part has 300000"):
        download(server.url, target, MOST)
    assert len(server.asked) == 1 + http._TRIES
    assert not target.exists()
    server.asked.clear()
    return target.with_name("scenes.zip.part")


def answer(status: str, body: bytes = b"", **headers: str) -> bytes:
    """The bytes of an answer; underscores in the names of headers stand for hyphens."""
    lines = [f"{name.replace('_', '-')}: {value}" for name, value in headers.items()]
    return "\r\n".join([f"HTTP/1.1 {status}", *lines, "", ""]).encode() + body


def test_a_lost_connection_is_resumed(server: Any, target: Path) -> None:
    server.content, server.cuts = CONTENT, [300_000, 1000]
    download(server.url, target, MOST, SHA256.upper())
    assert target.read_bytes() == CONTENT
    assert [file.name for file in target.parent.iterdir()] == ["scenes.zip"]
    assert server.asked == [None, "bytes=300000-", "bytes=301000-"]


def test_a_file_that_changed_is_downloaded_from_its_beginning(
    server: Any, target: Path, part: Path
) -> None:
    server.content, server.etag = CONTENT[::-1], '"second"'
    download(server.url, target, MOST)
    assert target.read_bytes() == CONTENT[::-1]


def test_a_part_from_another_address_is_not_continued(
    server: Any, target: Path, part: Path
) -> None:
    download(server.url + "?v=2", target, MOST)
    assert target.read_bytes() == CONTENT
    assert server.asked == [None]


def test_a_part_longer_than_the_file_is_discarded(server: Any, target: Path, part: Path) -> None:
    part.write_bytes(CONTENT + b"more")
    download(server.url, target, MOST)
    assert target.read_bytes() == CONTENT


@pytest.mark.parametrize(
    "headers",
    [
        {},
        {"Content_Range": "bytes 5-699999/700000"},
        {"Content_Range": "bytes 300000-699999/700000", "ETag": '"second"'},
    ],
    ids=str,
)
def test_a_range_that_does_not_continue_the_part_is_not_appended(
    server: Any, target: Path, part: Path, headers: dict[str, str]
) -> None:
    server.answers = [answer("206 Partial Content", b"x" * 400_000, **headers)]
    download(server.url, target, MOST)
    assert target.read_bytes() == CONTENT


@pytest.mark.parametrize(
    ("headers", "asked"),
    [
        ({"ETag": '"a"'}, "bytes=100-"),
        ({"Last_Modified": "Wed, 01 Jan 2020 10:00:00 GMT"}, "bytes=100-"),
        ({"ETag": 'W/"a"'}, None),
        ({}, None),
    ],
    ids=str,
)
def test_a_part_is_continued_only_if_its_version_is_known(
    server: Any, target: Path, headers: dict[str, str], asked: str | None
) -> None:
    server.content = CONTENT
    server.answers = [answer("200 OK", CONTENT[:100], Content_Length=str(MOST), **headers)]
    download(server.url, target, MOST)
    assert target.read_bytes() == CONTENT
    assert server.asked == [None, asked]


def test_a_server_that_brings_nothing_new_is_given_up(server: Any, target: Path) -> None:
    server.content, server.ranges, server.cuts = CONTENT, False, [200_000, 10] * 50
    with pytest.raises(DownloadError, match=r"ended after \d+ of 700000 bytes"):
        download(server.url, target, MOST)
    assert len(server.asked) <= 1 + http._TRIES


def test_another_content_is_not_kept(server: Any, target: Path) -> None:
    server.content = CONTENT[:-1] + b"?"
    with pytest.raises(DownloadError, match=f"sha256 is [0-9a-f]{{64}}, expected {SHA256}"):
        download(server.url, target, MOST, SHA256)
    assert list(target.parent.iterdir()) == []


def test_bytes_beyond_the_limit_are_not_written(server: Any, target: Path) -> None:
    """Also where the server does not say how many there are."""
    chunk = b"%x\r\n%b\r\n" % (MOST, CONTENT)
    server.answers = [answer("200 OK", chunk, Transfer_Encoding="chunked")]
    with pytest.raises(DownloadError, match=rf"{server.url}: \d+ bytes .* at most {MOST - 1} are"):
        download(server.url, target, MOST - 1)
    assert not target.exists()
    assert target.with_name("scenes.zip.part").stat().st_size < MOST


@pytest.mark.parametrize(
    ("sent", "why"),
    [
        (answer("404 Not\x1b Found"), "the server says 404 Not  Found"),
        (answer("200 OK", b"<html>", Content_Type="text/html; charset=utf-8"), "a web page"),
    ],
)
def test_a_refusal_is_not_repeated(server: Any, target: Path, sent: bytes, why: str) -> None:
    server.answers = [sent]
    with pytest.raises(DownloadError, match=rf"{server.url}: .*{why}"):
        download(server.url, target, MOST)
    assert len(server.asked) == 1


@pytest.mark.parametrize(
    "sent",
    [answer("503 Busy"), answer("429 Slowly"), b"HTTP/1.1 200 O"],
    ids=str,
)
def test_a_server_in_trouble_is_asked_again_after_growing_pauses(
    server: Any, target: Path, pauses: list[float], sent: bytes
) -> None:
    server.content, server.answers = CONTENT, [sent] * (http._TRIES - 1)
    download(server.url, target, MOST)
    assert target.read_bytes() == CONTENT
    assert pauses == [1, 2, 4, 8, 16]


def test_a_second_process_does_not_append_to_the_same_file(
    server: Any, target: Path, part: Path
) -> None:
    with part.open("ab") as held:
        fcntl.flock(held, fcntl.LOCK_EX)
        with pytest.raises(DownloadError, match=r"scenes\.zip: another process"):
            download(server.url, target, MOST)
    assert server.asked == []


def test_five_redirects_are_followed_and_no_more(server: Any, target: Path) -> None:
    server.content = CONTENT
    server.answers = [answer("302 Found", Location=f"/{number}") for number in range(5)]
    download(server.url, target, MOST)
    server.answers = [answer("302 Found", Location=f"/{number}") for number in range(6)]
    with pytest.raises(DownloadError, match="the server says 302"):
        download(server.url, target.with_name("again"), MOST)


@pytest.mark.parametrize(
    ("url", "location", "why"),
    [
        ("http://a.org/x", "http://A.org/y", None),
        ("http://a.org/x", "http://c.org:8/y", None),
        ("http://a.org/x", "http://b.org/y", "another host"),
        ("http://a.org/x", "http://a.org:81/y", "another host"),
        ("http://a.org/x", "http://a.org@b.org/y", "another host"),
        ("http://a.org/x", "http://a.org.b.org/y", "another host"),
        ("https://a.org/x", "http://a.org/y", "less safe"),
        ("http://a.org/x", "ftp://a.org/y", "less safe"),
    ],
)
def test_where_a_redirect_may_lead(url: str, location: str, why: str | None) -> None:
    handler = http._RedirectHandler("http://a.org/x", ["C.org:8"])
    request = Request(url)  # noqa: S310  nothing is opened
    arguments: Any = (request, io.BytesIO(), 302, "Found", {}, location)
    if why is None:
        followed = handler.redirect_request(*arguments)
        assert followed is not None
        assert followed.full_url == location
    else:
        with pytest.raises(DownloadError, match=rf"http://a.org/x: .*not followed \({why}"):
            handler.redirect_request(*arguments)
