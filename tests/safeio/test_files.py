"""What `pathlib` lacks: names, bounded reads, walks, removal and fsync."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import pytest

from xrgs.safeio import files
from xrgs.safeio.files import is_inside, is_name, is_transient, read_bytes, remove_path


@pytest.mark.parametrize("name", ["a b", "..a", "部屋", "🙂👨‍👩‍👧", "x" * 251, "a=b,c'\""])
def test_a_name_may_be_in_any_script(name: str) -> None:
    assert is_name(name)
    assert is_inside(f"{name}/{name}")


@pytest.mark.parametrize(
    "name",
    ["", "..", "a/b", "a\\b", "a\nb", "a\0", "\ud800", "x" * 252, None],
)
def test_a_name_that_leads_elsewhere_is_refused(name: object) -> None:
    assert not is_name(name)


@pytest.mark.parametrize("path", ["", "a/", "/a", "a/../b", "a//b", None])
def test_a_path_that_leads_outside_is_refused(path: object) -> None:
    assert not is_inside(path)


@pytest.fixture
def root(tmp_path: Path) -> Path:
    (tmp_path / "a" / "b").mkdir(parents=True)
    (tmp_path / "a" / "b" / "file").write_bytes(b"abc")
    (tmp_path / "outside").mkdir()
    (tmp_path / "outside" / "kept").touch()
    return tmp_path


def test_a_file_of_exactly_the_bound_is_read_and_a_larger_one_is_not(root: Path) -> None:
    file = root / "a/b/file"
    assert read_bytes(file, 3) == b"abc"
    with pytest.raises(OSError, match="3 bytes, at most 2 are read") as raised:
        read_bytes(file, 2)
    assert raised.value.filename == str(file)


@pytest.mark.parametrize("kind", ["pipe", "folder", "loop", "missing"])
def test_only_regular_files_are_read(root: Path, kind: str) -> None:
    odd = root / "odd"
    if kind == "pipe":
        os.mkfifo(odd)
    elif kind == "folder":
        odd.mkdir()
    elif kind == "loop":
        odd.symlink_to(odd)
    with pytest.raises(OSError, match="odd") as raised:
        read_bytes(odd)
    assert not is_transient(raised.value)


def test_whatever_is_there_is_removed_and_no_target_of_a_link(root: Path) -> None:
    for name in ("a/link", "link"):
        (root / name).symlink_to(root / "outside")
    for name in ("a", "link", "nothing", "a/b/file"):
        remove_path(root / name)
    assert [path.name for path in root.rglob("*")] == ["outside", "kept"]


def test_a_tree_is_synced_with_all_its_folders(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (root / "a/dangling").symlink_to("nowhere")
    synced = []
    monkeypatch.setattr(os, "fsync", lambda fd: synced.append(os.fstat(fd).st_ino))
    files.sync_tree(root / "a")
    assert sorted(synced) == sorted((root / n).stat().st_ino for n in ("a", "a/b", "a/b/file"))
    synced.clear()
    files.sync_name(root / "a")
    assert synced == [root.stat().st_ino]


def test_a_file_system_that_can_not_sync_folders_is_used_without(
    root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(number: int) -> None:
        def fsync(_: int) -> None:
            raise OSError(number, os.strerror(number))

        monkeypatch.setattr(os, "fsync", fsync)

    fail(errno.EINVAL)
    files.sync_name(root / "a")
    fail(errno.EIO)
    with pytest.raises(OSError, match="Input/output error") as raised:
        files.sync_name(root / "a")
    assert raised.value.filename == str(root)
