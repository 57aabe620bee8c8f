"""Downloads that are resumed, tried again and verified, from a server that cuts and refuses."""

from __future__ import annotations

import fcntl
import hashlib
import json
import random
import socket
from pathlib import Path
from typing import Any

import pytest

from xrgs.capture.download import http as fetch
from xrgs.capture.download.exchange import TooLargeError
from xrgs.capture.download.http import download
from xrgs.capture.download.part import DownloadError

CONTENT = random.Random(0).randbytes(700_000)
#: The largest size that is accepted: exactly the content's.
MOST = len(CONTENT)
SHA256 = hashlib.sha256(CONTENT).hexdigest()


@pytest.fixture
def target(tmp_path: Path) -> Path:
    return tmp_path / "made" / "scenes.zip"


def part(target: Path, content: bytes | None = None, validator: str = "") -> Path:
    file = target.with_name("scenes.zip.part")
    if content is not None:
        file.parent.mkdir(exist_ok=True)
        file.write_bytes(content)
    if validator:
        version = {"url": validator, "validator": '"first"', "total": None}
        file.with_name("scenes.zip.part.json").write_text(json.dumps(version))
    return file


@pytest.mark.parametrize("sha256", ["", SHA256, SHA256.upper()])
def test_a_file_is_downloaded_completely(server: Any, target: Path, sha256: str) -> None:
    server.content = CONTENT
    download(server.url, target, MOST, sha256)
    assert target.read_bytes() == CONTENT
    assert [file.name for file in target.parent.iterdir()] == ["scenes.zip"]
    assert server.asked == [None]


@pytest.mark.parametrize("sha256", ["", SHA256])
def test_a_lost_connection_is_resumed(server: Any, target: Path, sha256: str) -> None:
    server.content, server.cuts = CONTENT, [300_000, 1000]
    download(server.url, target, MOST, sha256)
    assert target.read_bytes() == CONTENT
    assert [file.name for file in target.parent.iterdir()] == ["scenes.zip"]
    assert server.asked == [None, "bytes=300000-", "bytes=301000-"]


def test_a_server_that_sends_no_more_is_given_up_and_the_part_is_kept(
    server: Any, target: Path, pauses: list[float]
) -> None:
    server.content, server.cuts = CONTENT, [300_000] + [0] * fetch._ATTEMPTS
    with pytest.raises(DownloadError, match=r"ended after 300000 of 700000 bytes.*300000 bytes"):
        download(server.url, target, MOST)
    assert len(server.asked) == 1 + fetch._ATTEMPTS
    assert not target.exists()
    assert part(target).read_bytes() == CONTENT[:300_000]
    server.asked.clear()
    download(server.url, target, MOST)  # as another process would
    assert target.read_bytes() == CONTENT
    assert server.asked == ["bytes=300000-"]


def test_a_part_is_kept_only_for_its_own_version(server: Any, target: Path) -> None:
    server.content, server.cuts = CONTENT, [300_000] + [0] * fetch._ATTEMPTS
    with pytest.raises(DownloadError):
        download(server.url, target, MOST)
    server.content, server.etag = CONTENT[::-1], '"second"'
    download(server.url, target, MOST)
    assert target.read_bytes() == CONTENT[::-1]


@pytest.mark.parametrize("record", ["", "{", "[]", '{"url": 1, "validator": 2, "total": 3}'])
def test_a_part_of_unknown_origin_is_not_continued(server: Any, target: Path, record: str) -> None:
    server.content = CONTENT
    part(target, b"x" * 1000).with_name("scenes.zip.part.json").write_text(record)
    download(server.url, target, MOST)
    assert target.read_bytes() == CONTENT
    assert server.asked == [None]


def test_a_validator_that_is_no_header_is_not_sent(server: Any, target: Path) -> None:
    server.content = CONTENT
    version = {"url": server.url, "validator": '"a"\r\nX: y', "total": None}
    part(target, b"x" * 1000).with_name("scenes.zip.part.json").write_text(json.dumps(version))
    download(server.url, target, MOST)
    assert target.read_bytes() == CONTENT


def test_a_part_from_another_address_is_not_continued(server: Any, target: Path) -> None:
    server.content = CONTENT
    part(target, b"x" * 1000, "http://127.0.0.1/other.zip")
    download(server.url, target, MOST)
    assert target.read_bytes() == CONTENT
    assert server.asked == [None]


def test_a_server_without_ranges_starts_over(server: Any, target: Path) -> None:
    server.content, server.ranges = CONTENT, False
    part(target, b"x" * 1000)
    download(server.url, target, MOST, SHA256)
    assert target.read_bytes() == CONTENT
    assert server.asked == ["bytes=1000-"]


def test_a_server_without_ranges_that_cuts_does_not_loop(server: Any, target: Path) -> None:
    server.content, server.ranges, server.cuts = CONTENT, False, [200_000, 10] * 50
    with pytest.raises(DownloadError, match="ended after 200000 of 700000 bytes"):
        download(server.url, target, MOST)
    assert len(server.asked) == 1 + fetch._ATTEMPTS


def test_a_server_that_gives_few_bytes_to_each_request_does_not_loop(
    server: Any, target: Path
) -> None:
    server.content, server.cuts = CONTENT, [3] * 99
    with pytest.raises(DownloadError, match="ended after 18 of 700000 bytes"):
        download(server.url, target, MOST)
    assert len(server.asked) == fetch._ATTEMPTS


@pytest.mark.parametrize("cuts", [[], [100_000]], ids=["joined before", "joined now as well"])
def test_a_joined_file_of_another_hash_is_downloaded_once_more(
    server: Any, target: Path, cuts: list[int]
) -> None:
    server.content, server.cuts = CONTENT, cuts
    part(target, b"x" * 1000)
    download(server.url, target, MOST, SHA256)
    assert target.read_bytes() == CONTENT
    assert server.asked[-1] is None


def test_a_joined_file_of_another_hash_is_downloaded_only_once_more(
    server: Any, target: Path
) -> None:
    server.content, server.cuts = CONTENT, [100_000, 600_000, 100_000]
    with pytest.raises(DownloadError, match="expected 0000"):
        download(server.url, target, MOST, "0" * 64)
    assert server.asked == [None, "bytes=100000-", None, "bytes=100000-"]
    assert list(target.parent.iterdir()) == []


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


def test_another_content_is_not_kept(server: Any, target: Path) -> None:
    server.content = CONTENT[:-1] + b"?"
    with pytest.raises(DownloadError, match=f"sha256 is [0-9a-f]{{64}}, expected {SHA256}"):
        download(server.url, target, MOST, SHA256)
    assert list(target.parent.iterdir()) == []


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
    # A range whose end in the file is not said can't be trusted to be the rest of it.
    assert (server.asked[-1] is not None) == length


@pytest.mark.parametrize("there", [MOST, MOST + 4])
def test_the_part_counts_towards_the_limit(server: Any, target: Path, there: int) -> None:
    server.content = CONTENT
    part(target, (CONTENT + b"more")[:there])
    with pytest.raises(TooLargeError, match=f"{MOST} bytes"):
        download(server.url, target, MOST - 1)
    assert not target.exists()


@pytest.mark.parametrize("status", [400, 403, 404, 410, 418])
def test_a_refusal_is_not_repeated(server: Any, target: Path, status: int) -> None:
    server.status = status
    with pytest.raises(DownloadError, match=rf"{server.url}: the server says {status}"):
        download(server.url, target, MOST)
    assert len(server.asked) == 1


@pytest.mark.parametrize("status", [429, 500, 502, 503, 504])
def test_a_server_in_trouble_is_asked_again_after_growing_pauses(
    server: Any, target: Path, pauses: list[float], status: int
) -> None:
    server.content, server.busy = CONTENT, [(status, {})] * (fetch._ATTEMPTS - 1)
    download(server.url, target, MOST)
    assert target.read_bytes() == CONTENT
    assert len(pauses) == fetch._ATTEMPTS - 1
    for number, pause in enumerate(pauses):
        assert 2**number / 2 <= pause <= 2**number
    server.busy = [(status, {})] * fetch._ATTEMPTS
    with pytest.raises(DownloadError, match=rf"can't be downloaded \(the server says {status}"):
        download(server.url, target.with_name("again"), MOST)


def test_pauses_are_random_and_bounded() -> None:
    pauses = [fetch._pause(50, 0) for _ in range(100)]
    assert len(set(pauses)) > 50
    assert 15 <= min(pauses) <= max(pauses) <= 30
    assert fetch._pause(0, 0) <= 1


@pytest.mark.parametrize(
    ("headers", "least", "most"),
    [
        ({"Retry-After": "77"}, 77, 77),
        ({"Retry-After": "999999999"}, 120, 120),
        ({"Retry-After": "9" * 40}, 0, 1),
        ({"Retry-After": "-5"}, 0, 1),
        ({"Retry-After": "soon"}, 0, 1),
        ({"Retry-After": "Wed, 01 Jan 2020 10:01:00 GMT"}, 55, 65),
    ],
    ids=str,
)
def test_the_wait_that_a_server_asks_for_is_kept_within_bounds(
    server: Any,
    target: Path,
    pauses: list[float],
    headers: dict[str, str],
    least: float,
    most: float,
) -> None:
    server.content, server.busy = CONTENT, [(503, headers)]
    server.date = "Wed, 01 Jan 2020 10:00:00 GMT"
    download(server.url, target, MOST)
    assert least <= pauses[0] <= most


def test_an_unreachable_server_is_named_with_the_file(target: Path, pauses: list[float]) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        url = f"http://127.0.0.1:{taken.getsockname()[1]}/x.zip"
    with pytest.raises(DownloadError, match=rf"{url}: can't be downloaded \(.*refused.*{target}"):
        download(url, target, MOST)
    assert len(pauses) == fetch._ATTEMPTS - 1


def test_a_second_process_does_not_append_to_the_same_file(server: Any, target: Path) -> None:
    server.content = CONTENT
    with part(target, b"").open("ab") as held:
        fcntl.flock(held, fcntl.LOCK_EX)
        with pytest.raises(DownloadError, match="another process"):
            download(server.url, target, MOST)
    assert server.asked == []


@pytest.mark.parametrize("url", ["", "file:///etc/hostname", "ftp://127.0.0.1/x", "http://[::1/x"])
def test_other_addresses_are_refused(target: Path, url: str) -> None:
    with pytest.raises(DownloadError, match="only http and https"):
        download(url, target, MOST)
    assert not target.parent.exists()


@pytest.mark.parametrize("url", ["http://", "http:///x", "http://127.0.0.1:99999/x"])
def test_a_malformed_address_is_refused(target: Path, url: str) -> None:
    with pytest.raises(DownloadError, match=url):
        download(url, target, MOST)
    assert not target.exists()


def test_a_file_is_on_the_disk_before_it_has_its_name(
    server: Any, target: Path, disk_events: list[str]
) -> None:
    """The bytes are synced before the rename, and the folder after it."""
    server.content = CONTENT
    download(server.url, target, MOST)
    assert disk_events[-3:] == [
        "sync scenes.zip.part",
        "rename scenes.zip.part to scenes.zip",
        "sync made",
    ]


def test_a_disk_that_can_not_take_it_is_named(server: Any, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(DownloadError, match=r"file/scenes\.zip\.part: "):
        download(server.url, tmp_path / "file" / "scenes.zip", MOST)
