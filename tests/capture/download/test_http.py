"""Downloads from a server that cuts, refuses, ignores ranges or sends something else."""

from __future__ import annotations

import fcntl
import hashlib
import random
import socket
from pathlib import Path
from typing import Any

import pytest

from xrgs.capture.download import http as fetch
from xrgs.capture.download.http import DownloadError, TooLargeError, download

CONTENT = random.Random(0).randbytes(700_000)
#: The largest size that is accepted: exactly the content's.
MOST = len(CONTENT)
SHA256 = hashlib.sha256(CONTENT).hexdigest()


@pytest.fixture
def target(tmp_path: Path) -> Path:
    return tmp_path / "made" / "scenes.zip"


def part(target: Path, content: bytes | None = None) -> Path:
    file = target.with_name("scenes.zip.part")
    if content is not None:
        file.parent.mkdir(exist_ok=True)
        file.write_bytes(content)
    return file


@pytest.mark.parametrize("sha256", ["", SHA256, SHA256.upper()])
def test_a_file_is_downloaded_completely(server: Any, target: Path, sha256: str) -> None:
    server.content = CONTENT
    download(server.url, target, MOST, sha256)
    assert target.read_bytes() == CONTENT
    assert [file.name for file in target.parent.iterdir()] == ["scenes.zip"]
    assert server.asked == [None]


def test_a_lost_connection_is_resumed(server: Any, target: Path) -> None:
    server.content, server.cuts = CONTENT, [300_000, 1000]
    download(server.url, target, MOST, SHA256)
    assert target.read_bytes() == CONTENT
    assert server.asked == [None, "bytes=300000-", "bytes=301000-"]


def test_a_server_that_sends_no_more_is_given_up_and_the_part_is_kept(
    server: Any, target: Path
) -> None:
    server.content, server.cuts = CONTENT, [300_000, 0]
    with pytest.raises(DownloadError, match=r"ended after 300000 of 700000 bytes.*300000 bytes"):
        download(server.url, target, MOST, SHA256)
    assert not target.exists()
    assert part(target).read_bytes() == CONTENT[:300_000]
    download(server.url, target, MOST, SHA256)
    assert target.read_bytes() == CONTENT
    assert server.asked[-1] == "bytes=300000-"


def test_a_server_without_ranges_starts_over(server: Any, target: Path) -> None:
    server.content, server.ranges = CONTENT, False
    part(target, b"x" * 1000)
    download(server.url, target, MOST, SHA256)
    assert target.read_bytes() == CONTENT
    assert server.asked == ["bytes=1000-"]


def test_a_server_without_ranges_that_cuts_does_not_loop(server: Any, target: Path) -> None:
    server.content, server.ranges, server.cuts = CONTENT, False, [1000] * 9
    with pytest.raises(DownloadError, match="ended after 1000 of 700000 bytes"):
        download(server.url, target, MOST)
    assert len(server.asked) == 2


def test_a_complete_part_is_only_renamed(server: Any, target: Path) -> None:
    server.content = CONTENT
    part(target, CONTENT)
    download(server.url, target, MOST, SHA256)
    assert target.read_bytes() == CONTENT


def test_a_part_longer_than_the_file_is_discarded(server: Any, target: Path) -> None:
    server.content = CONTENT
    part(target, CONTENT + b"more")
    download(server.url, target, MOST, SHA256)
    assert target.read_bytes() == CONTENT


def test_another_range_than_the_requested_one_is_refused(server: Any, target: Path) -> None:
    server.content, server.shift = CONTENT, 5
    part(target, CONTENT[:1000])
    with pytest.raises(
        DownloadError, match="requested the bytes from 1000 on, received those from 1005"
    ):
        download(server.url, target, MOST)


def test_another_content_is_not_kept(server: Any, target: Path) -> None:
    server.content = CONTENT[:-1] + b"?"
    with pytest.raises(DownloadError, match=f"sha256 is [0-9a-f]{{64}}, expected {SHA256}"):
        download(server.url, target, MOST, SHA256)
    assert list(target.parent.iterdir()) == []


def test_a_silent_server_is_given_up(
    server: Any, target: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    server.content, server.stall = CONTENT, 0.6
    monkeypatch.setattr(fetch, "_TIMEOUT", 0.1)
    with pytest.raises(DownloadError, match="timed out"):
        download(server.url, target, MOST)


@pytest.mark.parametrize("length", [True, False], ids=["said", "not said"])
def test_bytes_beyond_the_limit_are_not_written(server: Any, target: Path, length: bool) -> None:
    server.content, server.length = CONTENT, length
    for before in (b"", CONTENT[:1000]):
        part(target, before)
        with pytest.raises(
            TooLargeError, match=rf"{server.url}: \d+ bytes .* at most {MOST - 1} are allowed"
        ):
            download(server.url, target, MOST - 1, SHA256)
        assert not target.exists()
        there = len(part(target).read_bytes())
        assert there == len(before) if length else len(before) < there < MOST
    download(server.url, target, MOST, SHA256)  # what was received is not lost
    assert target.read_bytes() == CONTENT
    assert server.asked[-1] is not None


@pytest.mark.parametrize("there", [MOST, MOST + 4])
def test_the_part_counts_towards_the_limit(server: Any, target: Path, there: int) -> None:
    server.content = CONTENT
    part(target, (CONTENT + b"more")[:there])
    with pytest.raises(TooLargeError, match=f"{MOST} bytes"):
        download(server.url, target, MOST - 1)
    assert not target.exists()


@pytest.mark.parametrize("status", [403, 404, 500])
def test_a_refusal_is_named(server: Any, target: Path, status: int) -> None:
    server.status = status
    with pytest.raises(DownloadError, match=rf"{server.url}: the server says {status}"):
        download(server.url, target, MOST)


def test_a_web_page_is_refused(server: Any, target: Path) -> None:
    server.content, server.content_type = b"<html>", "text/html; charset=utf-8"
    with pytest.raises(DownloadError, match="sent a web page"):
        download(server.url, target, MOST)
    assert not target.exists()


def test_an_unreachable_server_is_named_with_the_file(target: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        url = f"http://127.0.0.1:{taken.getsockname()[1]}/x.zip"
    with pytest.raises(DownloadError, match=rf"{url}: can't be downloaded \(.*refused.*{target}"):
        download(url, target, MOST)


def test_a_second_process_does_not_append_to_the_same_file(server: Any, target: Path) -> None:
    server.content = CONTENT
    with part(target, b"").open("ab") as held:
        fcntl.flock(held, fcntl.LOCK_EX)
        with pytest.raises(DownloadError, match="another process"):
            download(server.url, target, MOST)
    assert server.asked == []


@pytest.mark.parametrize("url", ["", "file:///etc/hostname", "ftp://127.0.0.1/x"])
def test_other_addresses_are_refused(target: Path, url: str) -> None:
    with pytest.raises(DownloadError, match="only http and https"):
        download(url, target, MOST)
    assert not target.parent.exists()


def test_a_disk_that_can_not_take_it_is_named(server: Any, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(DownloadError, match=r"file/scenes\.zip\.part: "):
        download(server.url, tmp_path / "file" / "scenes.zip", MOST)
