"""The part of a file on the disk: its record, its lock and its last rename."""

from __future__ import annotations

import fcntl
import json
from pathlib import Path

import pytest

from xrgs.capture.download import part as part_module
from xrgs.capture.download.part import DownloadError, Version, open_part

VERSION = Version("http://a.org/x", '"1"', 7)


def test_a_part_and_its_version_are_found_again(tmp_path: Path) -> None:
    target = tmp_path / "made" / "x.zip"
    with open_part(target) as part:
        assert (part.size, part.version, part.joined) == (0, Version(), False)
        part.begin(VERSION)
        part.append(b"abc")
    with open_part(target) as part:
        assert (part.size, part.version, part.joined) == (3, VERSION, True)
        part.append(b"defg")
        part.complete()
    assert target.read_bytes() == b"abcdefg"
    assert [file.name for file in target.parent.iterdir()] == ["x.zip"]


def test_bytes_of_another_version_are_gone_before_it_is_recorded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A crash between the two must not leave the bytes of one version with the other's record."""
    target = tmp_path / "x.zip"
    with open_part(target) as part:
        part.begin(Version("http://a.org/x", '"0"'))
        part.append(b"old")
    sizes = []
    monkeypatch.setattr(
        part_module, "write_json", lambda *_: sizes.append((tmp_path / "x.zip.part").stat().st_size)
    )
    with open_part(target) as part:
        part.begin(VERSION)
        part.append(b"new")
        assert not part.joined
        assert part.size == 3
    assert sizes == [0]
    assert (tmp_path / "x.zip.part").read_bytes() == b"new"


def test_a_removed_part_leaves_nothing(tmp_path: Path) -> None:
    with open_part(tmp_path / "x.zip") as part:
        part.begin(VERSION)
        part.remove()
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "record",
    [
        "",
        "[1]",
        "{}",
        json.dumps({"url": "u", "validator": "v"}),
        json.dumps({"url": 5, "validator": "v", "total": None}),
        json.dumps({"url": "u", "validator": None, "total": None}),
        json.dumps({"url": "u", "validator": "a\r\nX: y", "total": None}),
        json.dumps({"url": "u", "validator": "\u00e9", "total": None}),
        "[" * 100_000,
        " " * (1 << 17),
    ],
    ids=lambda record: record[:40],
)
def test_a_damaged_record_is_of_no_version(tmp_path: Path, record: str) -> None:
    (tmp_path / "x.zip.part").write_bytes(b"abc")
    (tmp_path / "x.zip.part.json").write_text(record)
    with open_part(tmp_path / "x.zip") as part:
        assert part.version == Version()


def test_one_process_holds_the_part(tmp_path: Path) -> None:
    target = tmp_path / "x.zip"
    with open_part(target), pytest.raises(DownloadError, match="another process"):
        open_part(target).__enter__()


def test_a_part_that_has_become_the_file_meanwhile_is_not_appended_to(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The process that held the lock renames the part after this one has opened it."""
    target = tmp_path / "x.zip"
    monkeypatch.setattr(fcntl, "flock", lambda *_: (tmp_path / "x.zip.part").rename(target))
    with pytest.raises(DownloadError, match="another process"):
        open_part(target).__enter__()
    assert target.read_bytes() == b""
