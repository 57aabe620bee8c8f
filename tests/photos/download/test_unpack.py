"""Honest, damaged and hostile zip archives."""

from __future__ import annotations

import stat
import zipfile
from pathlib import Path

import pytest

from xrgs.photos.download import unpack as unpack_module
from xrgs.photos.download.scenes import UnpackError, unpack

GOOD = {"set/fern/images/a.png": b"a" * 50, "set/fern/poses.npy": b"p", "set/room/b.png": b"b"}


def archive(tmp_path: Path, extra: dict[str | zipfile.ZipInfo, bytes] | None = None) -> Path:
    file = tmp_path / "set.zip"
    with zipfile.ZipFile(file, "w") as made:
        made.mkdir("set/fern")
        for name, content in (GOOD | (extra or {})).items():
            made.writestr(name, content)
    return file


def names(folder: Path) -> list[str]:
    return sorted(f.relative_to(folder).as_posix() for f in folder.rglob("*") if f.is_file())


def test_one_folder_is_written_and_nothing_else(tmp_path: Path) -> None:
    target = tmp_path / "data" / "fern"
    unpack(archive(tmp_path), "set/fern", target)
    assert names(tmp_path / "data") == ["fern/images/a.png", "fern/poses.npy"]
    assert (target / "images" / "a.png").read_bytes() == b"a" * 50
    assert [f.name for f in target.parent.iterdir()] == ["fern"]
    (tmp_path / "plain").mkdir()
    assert target.stat().st_mode == (tmp_path / "plain").stat().st_mode  # not TemporaryDirectory's


def test_an_empty_folder_may_be_filled_and_no_other(tmp_path: Path) -> None:
    target = tmp_path / "fern"
    target.mkdir()
    unpack(archive(tmp_path), "set/fern", target)
    (target / "mine.txt").write_text("kept")
    with pytest.raises(UnpackError, match="can't be unpacked into"):
        unpack(archive(tmp_path), "set/fern", target)
    assert (target / "mine.txt").read_text() == "kept"
    assert len(list(tmp_path.glob(".*"))) == 0


def test_a_name_that_leads_out_is_refused(tmp_path: Path) -> None:
    file = archive(tmp_path, {"set/fern/../../out.txt": b"x"})
    with pytest.raises(UnpackError, match=r"set\.zip: .* in it leads out of its folder"):
        unpack(file, "set/fern", tmp_path / "deep" / "fern")
    assert names(tmp_path) == ["set.zip"]


@pytest.mark.parametrize("name", ["../out.txt", "/out.txt", "set/room/../../../out.txt"])
def test_names_outside_of_the_folder_are_not_written(tmp_path: Path, name: str) -> None:
    unpack(archive(tmp_path, {name: b"x"}), "set/fern", tmp_path / "deep" / "fern")
    assert names(tmp_path) == ["deep/fern/images/a.png", "deep/fern/poses.npy", "set.zip"]


def test_a_link_becomes_a_plain_file(tmp_path: Path) -> None:
    link = zipfile.ZipInfo("set/fern/link")
    link.create_system = 3  # unix: the mode counts
    link.external_attr = (stat.S_IFLNK | 0o644) << 16
    unpack(archive(tmp_path, {link: b"/etc/passwd"}), "set/fern", tmp_path / "fern")
    assert (tmp_path / "fern" / "link").read_bytes() == b"/etc/passwd"
    assert not (tmp_path / "fern" / "link").is_symlink()


def test_a_file_larger_than_declared_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "set.zip"
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as made:
        made.writestr("set/fern/zeros.png", bytes(1 << 20))
    content = file.read_bytes()
    declared = (1 << 20).to_bytes(4, "little")
    file.write_bytes(content.replace(declared, (99).to_bytes(4, "little")))
    with pytest.raises(UnpackError, match="not a complete zip archive"):
        unpack(file, "set/fern", tmp_path / "fern")
    assert names(tmp_path) == ["set.zip"]


@pytest.mark.parametrize("limit", ["_MAX_BYTES", "_MAX_FILES"])
def test_too_many_files_or_bytes_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, limit: str
) -> None:
    monkeypatch.setattr(unpack_module, limit, 1)
    with pytest.raises(UnpackError, match="unpacks to 2 files and 51 bytes; at most"):
        unpack(archive(tmp_path), "set/fern", tmp_path / "fern")


def test_the_files_are_on_the_disk_before_the_folder_has_its_name(
    tmp_path: Path, disk_events: list[str]
) -> None:
    unpack(archive(tmp_path), "set/fern", tmp_path / "data" / "fern")
    *before, renamed, after = disk_events
    assert sorted(before) == ["sync a.png", "sync fern", "sync images", "sync poses.npy"]
    assert [renamed, after] == ["rename fern to fern", "sync data"]


@pytest.mark.parametrize("damage", ["cut", "flip", "encrypted"])
def test_a_damaged_archive_leaves_nothing_behind(tmp_path: Path, damage: str) -> None:
    file = archive(tmp_path)
    content = bytearray(file.read_bytes())
    if damage == "cut":
        content = content[:-30]
    elif damage == "flip":
        content[content.index(b"aaaa")] ^= 1
    else:
        content[content.index(b"PK\x01\x02", content.index(b"PK\x01\x02") + 1) + 8] |= 1
    file.write_bytes(content)
    with pytest.raises(UnpackError, match=r"set\.zip: not a complete zip archive"):
        unpack(file, "set/fern", tmp_path / "fern")
    assert [f.name for f in tmp_path.iterdir()] == ["set.zip"]
