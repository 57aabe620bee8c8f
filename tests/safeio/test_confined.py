"""Paths below a root: nothing in the root leads out of it, blocks, or makes the root again."""

from __future__ import annotations

import errno
import os
import socket
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from xrgs.safeio import beneath
from xrgs.safeio.confined import (
    ConfinedPath,
    ReplacedError,
    RootMissingError,
    confined,
    is_passing,
)

if TYPE_CHECKING:
    from collections.abc import Callable

OPENERS = ["openat2", "by hand"]


@pytest.fixture(params=OPENERS, autouse=True)
def _opener(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Both ways of resolving a path behave alike, to the kind of the error."""
    if request.param == "by hand":
        monkeypatch.setattr(beneath, "_openat2", lambda: None)
    elif beneath._openat2() is None:
        pytest.skip("this system has no openat2")


@pytest.fixture
def outside(tmp_path: Path) -> Path:
    folder = tmp_path / "outside"
    folder.mkdir()
    (folder / "victim").write_text("kept")
    return folder


@pytest.fixture
def root(tmp_path: Path) -> ConfinedPath:
    folder = tmp_path / "root"
    (folder / "a" / "b").mkdir(parents=True)
    (folder / "a" / "b" / "file").write_bytes(b"abc")
    return ConfinedPath(folder)


def test_a_file_below_the_root_is_read(root: ConfinedPath) -> None:
    file = root / "a/b/file"
    assert file.read_bytes() == b"abc"
    assert file.read_text() == "abc"
    assert (file.exists(), file.is_file(), file.is_dir(), file.is_link()) == (
        True,
        True,
        False,
        False,
    )
    assert file.parent == root / "a" / "b"
    assert file.parent.is_dir()
    assert (file.name, str(file)) == ("file", str(root.root / "a/b/file"))
    assert file.relative_to(root / "a") == "b/file"


def test_a_confined_path_is_opened_by_nothing_else(root: ConfinedPath) -> None:
    with pytest.raises(TypeError):
        os.fspath(root / "a/b/file")  # type: ignore[call-overload]


@pytest.mark.parametrize("inside", ["", ".", "..", "../root/a", "a/../b", "/etc", "a//b", "a\0b"])
def test_a_path_has_no_name_that_leads_elsewhere(root: ConfinedPath, inside: str) -> None:
    with pytest.raises(ValueError, match="is not a path inside"):
        root / inside


@pytest.mark.parametrize("target", ["../outside", "a", ".", "/"])
def test_no_link_below_the_root_is_followed_wherever_it_leads(
    root: ConfinedPath, outside: Path, target: str
) -> None:
    (root.root / "link").symlink_to(target)
    name = "victim" if target == "../outside" else "b/file"
    with pytest.raises(OSError, match="link") as raised:
        (root / "link" / name).read_bytes()
    assert raised.value.errno in {errno.ELOOP, errno.ENOTDIR}
    with pytest.raises(OSError, match="link"):
        (root / "link").read_bytes()
    with pytest.raises(OSError, match="link"):
        (root / "link" / "new").make_folder()
    with pytest.raises(OSError, match="link"):
        (root / "link" / "new").create()
    with pytest.raises(OSError, match="link"):
        (root / "link").append()
    assert (root / "link").is_link()
    assert not (root / "link").is_dir()
    assert sorted(path.name for path in outside.iterdir()) == ["victim"]


def test_a_root_that_the_user_named_may_be_a_link(root: ConfinedPath, tmp_path: Path) -> None:
    (tmp_path / "named").symlink_to(root.root)
    (tmp_path / "named-file").symlink_to(root.root / "a/b/file")
    assert (ConfinedPath(tmp_path / "named") / "a/b/file").read_bytes() == b"abc"
    assert ConfinedPath(tmp_path / "named-file").read_bytes() == b"abc"
    assert ConfinedPath(tmp_path / "named").is_dir()


def _pipe(path: Path) -> None:
    os.mkfifo(path)


def _socket(path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as bound:
        bound.bind(str(path))


def _folder(path: Path) -> None:
    path.mkdir()


@pytest.mark.parametrize("make", [_pipe, _socket, _folder])
def test_only_regular_files_are_opened(
    root: ConfinedPath,
    tmp_path: Path,
    make: Callable[[Path], None],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(root.root)  # the name of a socket must be short
    make(Path("odd"))
    for path in (root / "odd", ConfinedPath(root.root / "odd")):
        with pytest.raises(OSError, match="odd") as raised:
            path.read_bytes()
        assert not is_passing(raised.value)
        assert not path.is_file()
    assert root.sizes(["odd"]) == {"odd": -1}


def test_a_file_of_exactly_the_bound_is_read_and_a_larger_one_is_not(root: ConfinedPath) -> None:
    assert (root / "a/b/file").read_bytes(3) == b"abc"
    with pytest.raises(OSError, match="3 bytes, at most 2 are read"):
        (root / "a/b/file").read_bytes(2)


def test_sizes_are_those_of_regular_files(root: ConfinedPath, outside: Path) -> None:
    (root.root / "link").symlink_to(outside)
    (root.root / "top").write_bytes(b"12")
    names = ["a/b/file", "top", "a/b", "a/none", "none/none", "top/under", "link/victim"]
    assert root.sizes(names) == dict(zip(names, [3, 2, -1, -1, -1, -1, -1], strict=True))


def test_walking_reports_files_and_links_and_follows_none(
    root: ConfinedPath, outside: Path
) -> None:
    (root.root / "a" / "link").symlink_to(outside)
    assert sorted(name for name, _ in root.walk()) == ["a/b/file", "a/link"]
    assert root.folders() == ["a"]
    assert [path.name for path in (root / "a").iterdir()] == ["b", "link"]


def test_a_walk_ends_where_folders_are_nested_too_deeply(root: ConfinedPath) -> None:
    (root / "/".join(["d"] * 60)).make_folder()
    with pytest.raises(OSError, match="nested too deeply"):
        list(root.walk())


def test_files_are_created_appended_to_renamed_and_removed(root: ConfinedPath) -> None:
    (root / "new/folder").make_folder()
    (root / "new/folder").make_folder()
    with pytest.raises(FileExistsError):
        (root / "new/folder").make_folder(exclusive=True)
    file = root / "new/folder/file"
    for text in (b"1", b"2"):
        with file.append() as stream:
            stream.write(text)
    with pytest.raises(FileExistsError, match="new/folder/file"):
        file.create()
    file.rename(root / "a/moved")
    assert (root / "a/moved").read_bytes() == b"12"
    (root / "a/moved").sync_name()
    (root / "a/moved").unlink()
    (root / "a/moved").unlink(missing_ok=True)
    with pytest.raises(FileNotFoundError, match="a/moved"):
        (root / "a/moved").unlink()
    (root / "new").remove()
    (root / "new").remove()
    assert root.names() == ["a"]


def test_removing_leaves_what_a_link_leads_to(root: ConfinedPath, outside: Path) -> None:
    (root.root / "a" / "link").symlink_to(outside)
    (root / "a").remove()
    (root.root / "link").symlink_to(outside)
    (root / "link").remove()
    assert root.names() == []
    assert (outside / "victim").read_text() == "kept"


def test_a_vanished_root_is_not_made_again(root: ConfinedPath, tmp_path: Path) -> None:
    root.root.rename(tmp_path / "moved")
    for act in (
        (root / "a/new").make_folder,
        (root / "new").create,
        (root / "a/b/file").read_bytes,
        (root / "a").exists,
        (root / "a").names,
        lambda: (root / "a/b/file").rename(root / "other"),
    ):
        with pytest.raises(RootMissingError, match="root") as raised:
            act()
        assert is_passing(raised.value)
    assert not root.root.exists()
    root.make_root()
    assert root.names() == []


def test_names_that_are_not_utf_8_are_listed_and_opened(root: ConfinedPath) -> None:
    (root.root / os.fsdecode(b"\xff")).write_bytes(b"1")
    (odd,) = [path for path in root.iterdir() if path.name != "a"]
    assert odd.read_bytes() == b"1"


@pytest.mark.parametrize(
    ("number", "passing"),
    [
        (errno.EIO, True),
        (errno.ESTALE, True),
        (errno.EACCES, True),
        (errno.EMFILE, True),
        (errno.ENOENT, False),
        (errno.ELOOP, False),
        (errno.EFBIG, False),
    ],
)
def test_errors_of_disks_and_permissions_may_pass(number: int, passing: bool) -> None:
    assert is_passing(OSError(number, os.strerror(number))) is passing


def test_an_error_of_a_library_is_about_the_content() -> None:
    assert not is_passing(OSError("cannot identify image file"))


def test_a_file_is_updated_where_it_is_and_never_created(tmp_path: Path) -> None:
    file = ConfinedPath(tmp_path) / "a"
    with pytest.raises(FileNotFoundError):
        file.update()
    file.path.write_bytes(b"before")
    inode = file.lstat().st_ino
    with file.update() as stream:
        assert stream.read() == b"before"
        stream.seek(0)
        stream.write(b"be")
        file.unlink()
        file.path.write_bytes(b"another's")
        stream.write(b"hind")
    assert file.read_bytes() == b"another's"
    assert file.lstat().st_ino != inode


def test_an_error_of_the_disk_is_no_answer(
    root: ConfinedPath, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object, **__: object) -> None:
        raise OSError(errno.EIO, os.strerror(errno.EIO))

    monkeypatch.setattr(os, "stat", fail)
    for look in (root / "a").exists, (root / "a").is_dir, lambda: root.sizes(["a/b/file"]):
        with pytest.raises(OSError, match="Input/output error"):
            look()


def test_a_path_of_a_user_is_a_root_and_a_confined_one_stays(root: ConfinedPath) -> None:
    assert confined(root / "a") == root / "a"
    assert confined(root.root) == root


# Pinned roots


@pytest.fixture
def pinned(root: ConfinedPath) -> ConfinedPath:
    return (root / "a").pinned()


def test_a_pinned_root_is_used_as_any_other_while_its_name_leads_to_it(
    pinned: ConfinedPath,
) -> None:
    assert (pinned / "b/file").read_bytes() == b"abc"
    (pinned / "c/d").make_folder()
    (pinned / "c").rename(pinned / "e")
    assert [path.name for path in pinned.iterdir()] == ["b", "e"]
    assert pinned.identity() == (pinned.path.stat().st_dev, pinned.path.stat().st_ino)


def test_nothing_is_done_in_a_folder_that_has_taken_the_name_of_a_pinned_root(
    pinned: ConfinedPath, root: ConfinedPath
) -> None:
    pinned.path.rename(root.root / "old")
    (root.root / "a").mkdir()
    for use in (
        (pinned / "file").create,
        (pinned / "file").append,
        (pinned / "b/file").read_bytes,
        (pinned / "b").make_folder,
        lambda: (pinned / "b/file").unlink(missing_ok=True),
        (pinned / "b").parent.names,
        lambda: (pinned / "b").with_name("c").make_folder(),
        lambda: list(pinned.walk()),
        (pinned / "b").remove,
        (pinned / "b/file").exists,
    ):
        with pytest.raises(ReplacedError, match="it was replaced by another folder") as raised:
            use()
        assert raised.value.filename == str(pinned.path)
        assert is_passing(raised.value)
    assert not list((root.root / "a").iterdir())
    assert (root.root / "old/b/file").read_bytes() == b"abc"


def test_what_was_opened_before_a_takeover_stays_in_the_old_folder(
    pinned: ConfinedPath, root: ConfinedPath
) -> None:
    with pinned._opened() as descriptor:
        pinned.path.rename(root.root / "old")
        (root.root / "a").mkdir()
        os.mkdir("made", dir_fd=descriptor)
    assert (root.root / "old/made").is_dir()
    assert not list((root.root / "a").iterdir())


def test_a_pinned_root_that_is_removed_is_missing_and_its_inode_is_not_used_again(
    pinned: ConfinedPath, root: ConfinedPath
) -> None:
    (root / "a").remove()
    with pytest.raises(RootMissingError):
        (pinned / "file").create()
    for number in range(20):  # a file system may give out a free inode at once
        (root.root / f"other-{number}").mkdir()
        assert (root / f"other-{number}").identity() != pinned.identity()


def test_a_root_is_pinned_only_where_it_is_the_expected_one(root: ConfinedPath) -> None:
    known = (root / "a").identity()
    assert ((root / "a").pinned(known) / "b/file").read_bytes() == b"abc"
    (root.root / "a").rename(root.root / "old")
    (root.root / "a").mkdir()
    with pytest.raises(ReplacedError, match="before this process began"):
        (root / "a").pinned(known)


def test_a_tree_is_synced_with_all_its_folders(
    root: ConfinedPath, monkeypatch: pytest.MonkeyPatch
) -> None:
    (root.root / "a/pipe").symlink_to("nowhere")
    synced = []
    monkeypatch.setattr(os, "fsync", lambda fd: synced.append(os.fstat(fd).st_ino))
    root.sync_tree()
    paths = [root.root, *(root.root / name for name in ("a", "a/b", "a/b/file"))]
    assert sorted(synced) == sorted(path.stat().st_ino for path in paths)


def test_a_root_is_made_on_its_own_only_where_nothing_has_its_name(tmp_path: Path) -> None:
    made = ConfinedPath(tmp_path / "new")
    made.make_folder()
    assert not made.exists()
    made.make_folder(exclusive=True)
    assert made.is_dir()
    with pytest.raises(FileExistsError):
        made.make_folder(exclusive=True)
    assert made.siblings() == ["new"]


def test_a_root_is_reached_through_a_folder_that_cant_be_listed(
    root: ConfinedPath, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened = os.open

    def refuse(path: str | Path, *arguments: int, **keywords: int) -> int:
        if Path(path) == root.root.parent:
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), path)
        return opened(path, *arguments, **keywords)

    monkeypatch.setattr(os, "open", refuse)
    assert ConfinedPath(root.root / "a/b/file").read_bytes() == b"abc"
    assert root.is_dir()
    assert not ConfinedPath(root.root / "none" / "file").exists()
