"""Honest, damaged and hostile zip archives."""

from __future__ import annotations

import stat
import zipfile
from pathlib import Path

import pytest

from xrgs.capture.download import unpack as unpack_module
from xrgs.capture.download.unpack import UnpackError, unpack

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


def entry(name: str, mode: int = stat.S_IFREG) -> zipfile.ZipInfo:
    info = zipfile.ZipInfo(name)
    info.create_system = 3  # unix: the mode counts
    info.external_attr = (mode | 0o644) << 16
    return info


def test_one_folder_is_written_and_nothing_else(tmp_path: Path) -> None:
    target = tmp_path / "data" / "fern"
    unpack(archive(tmp_path), "set/fern", target)
    assert names(tmp_path / "data") == ["fern/images/a.png", "fern/poses.npy"]
    assert (target / "images" / "a.png").read_bytes() == b"a" * 50
    assert [f.name for f in target.parent.iterdir()] == ["fern"]


def test_the_folder_has_the_permissions_of_the_umask(tmp_path: Path) -> None:
    (tmp_path / "plain").mkdir()
    unpack(archive(tmp_path), "set/fern", tmp_path / "fern")
    assert (tmp_path / "fern").stat().st_mode == (tmp_path / "plain").stat().st_mode


def test_an_empty_folder_may_be_filled_and_no_other(tmp_path: Path) -> None:
    target = tmp_path / "fern"
    target.mkdir()
    unpack(archive(tmp_path), "set/fern", target)
    (target / "mine.txt").write_text("kept")
    with pytest.raises(UnpackError, match="can't be unpacked into"):
        unpack(archive(tmp_path), "set/fern", target)
    assert (target / "mine.txt").read_text() == "kept"
    assert len(list(tmp_path.glob(".*"))) == 0


@pytest.mark.parametrize(
    ("name", "why"),
    [
        ("set/fern/../../out.txt", "leads out"),
        ("../out.txt", "leads out"),
        ("set/./fern/x", "leads out"),
        ("set//fern/x", "leads out"),
        ("/out.txt", "not a relative path"),
        ("C:/out.txt", "not a relative path"),
        ("set/fern/a\\..\\..\\out.txt", "not a relative path"),
        ("set/fern/NUL", "not a valid file name"),
        ("set/fern/com1.png", "not a valid file name"),
        ("set/fern/a\nb", "not a valid file name"),
    ],
)
def test_one_unsafe_name_refuses_the_whole_archive(tmp_path: Path, name: str, why: str) -> None:
    file = archive(tmp_path, {name: b"x"})
    with pytest.raises(UnpackError, match=f"set.zip: .* in it .*{why}.*nothing was unpacked"):
        unpack(file, "set/fern", tmp_path / "deep" / "down" / "fern")
    assert [f.name for f in tmp_path.iterdir()] == ["set.zip"]


@pytest.mark.parametrize("kind", [stat.S_IFLNK, stat.S_IFCHR, stat.S_IFIFO])
def test_links_and_devices_are_refused(tmp_path: Path, kind: int) -> None:
    file = archive(tmp_path, {entry("set/fern/link", kind): b"/etc/passwd"})
    with pytest.raises(UnpackError, match="is a link or a device"):
        unpack(file, "set/fern", tmp_path / "fern")


def test_a_bomb_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "set.zip"
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as made:
        made.writestr("set/fern/zeros.png", bytes(1 << 20))
    with pytest.raises(
        UnpackError, match=r"unpacks \d+ bytes to 1048576.*too much for a folder of photo"
    ):
        unpack(file, "set/fern", tmp_path / "fern")


def test_a_folder_is_on_the_disk_before_it_has_its_name(
    tmp_path: Path, disk_events: list[str]
) -> None:
    """Each file and folder is synced before the rename, and the folder around them after it."""
    file = archive(tmp_path)
    unpack(file, "set/fern", tmp_path / "data" / "fern")
    (renamed,) = (n for n, event in enumerate(disk_events) if event.startswith("rename"))
    before, after = disk_events[:renamed], disk_events[renamed + 1 :]
    *files, made = sorted(before, key=lambda event: ".unpacking" in event)
    assert sorted(files) == ["sync a.png", "sync images", "sync poses.npy"]
    assert made.startswith("sync .unpacking-")
    assert after == ["sync data"]


@pytest.mark.parametrize(
    ("limit", "why"), [("_MAX_BYTES", "unpacks to 51 bytes"), ("_MAX_FILES", "holds 2 files")]
)
def test_too_many_files_or_bytes_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, limit: str, why: str
) -> None:
    monkeypatch.setattr(unpack_module, limit, 1)
    with pytest.raises(UnpackError, match=why):
        unpack(archive(tmp_path), "set/fern", tmp_path / "fern")


def test_two_names_that_differ_in_case_alone_are_refused(tmp_path: Path) -> None:
    file = archive(tmp_path, {"set/fern/POSES.npy": b"x"})
    with pytest.raises(UnpackError, match="two files of one name"):
        unpack(file, "set/fern", tmp_path / "fern")


def test_a_folder_that_is_not_in_it_is_named(tmp_path: Path) -> None:
    with pytest.raises(UnpackError, match=r"set\.zip: there is no folder set/fer in it"):
        unpack(archive(tmp_path), "set/fer", tmp_path / "fern")


@pytest.mark.parametrize("damage", ["cut", "flip", "text", "gone"])
def test_a_damaged_archive_leaves_nothing_behind(tmp_path: Path, damage: str) -> None:
    file = archive(tmp_path)
    content = bytearray(file.read_bytes())
    if damage == "flip":
        content[content.index(b"aaaa")] ^= 1
    file.write_bytes(
        {"cut": bytes(content[:-30]), "text": b"not a zip"}.get(damage, bytes(content))
    )
    if damage == "gone":
        file.unlink()
    with pytest.raises(UnpackError, match=r"set\.zip"):
        unpack(file, "set/fern", tmp_path / "fern")
    assert {f.name for f in tmp_path.iterdir()} <= {"set.zip"}


def test_an_encrypted_archive_is_refused(tmp_path: Path) -> None:
    file = archive(tmp_path)
    content = bytearray(file.read_bytes())
    start = content.index(b"PK\x01\x02")  # the first entry of the central directory
    content[start + 8] |= 1
    file.write_bytes(content)
    with pytest.raises(UnpackError, match="is encrypted"):
        unpack(file, "set/fern", tmp_path / "fern")
