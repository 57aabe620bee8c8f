"""Files that are written atomically: whole, or as they were before."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import pytest

from xrgs.safeio.atomic import atomic_writer, write_text


def test_the_new_content_appears_at_the_end_of_the_block(tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.write_bytes(b"old")
    with atomic_writer(file) as stream:
        stream.write(b"new")
        stream.flush()
        assert file.read_bytes() == b"old"
    assert file.read_bytes() == b"new"
    assert list(tmp_path.iterdir()) == [file]


def test_an_exception_leaves_the_old_content_and_no_temporary_file(tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.write_bytes(b"old")
    with pytest.raises(TypeError), atomic_writer(file) as stream:
        stream.writelines([b"half", "not bytes"])  # type: ignore[list-item]
    assert file.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [file]


def test_an_error_of_the_disk_names_the_file(tmp_path: Path) -> None:
    file = tmp_path / "file"
    for name, named in ((None, str(file)), ("another", "another")):
        with pytest.raises(OSError, match="full") as raised, atomic_writer(file):
            raise OSError(errno.ENOSPC, "full", name)
        assert raised.value.filename == named
    with pytest.raises(FileNotFoundError) as missing, atomic_writer(tmp_path / "gone" / "file"):
        pass
    assert missing.value.filename == str(tmp_path / "gone" / "file")
    (tmp_path / "folder").mkdir()
    with pytest.raises(IsADirectoryError) as folder, atomic_writer(tmp_path / "folder"):
        pass
    assert str(folder.value).endswith(f"{str(tmp_path / 'folder')!r}")


def test_others_can_read_the_file_as_the_umask_allows(tmp_path: Path) -> None:
    before = os.umask(0o022)
    try:
        write_text(tmp_path / "file", "text")
    finally:
        os.umask(before)
    assert (tmp_path / "file").stat().st_mode & 0o777 == 0o644


@pytest.mark.parametrize("durable", [True, False])
def test_only_a_durable_file_waits_for_the_disk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, durable: bool
) -> None:
    synced: list[int] = []
    monkeypatch.setattr(os, "fsync", synced.append)
    write_text(tmp_path / "file", "text", durable=durable)
    assert len(synced) == (2 if durable else 0)  # the content, and the name
    assert (tmp_path / "file").read_text() == "text"
