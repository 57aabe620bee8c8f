"""Hashes of files, folders that are set aside, and locks."""

from __future__ import annotations

import hashlib
from pathlib import Path

import pytest

from xrgs.capture import sealed
from xrgs.safeio.confined import ConfinedPath


def test_hashes_are_those_of_the_bytes(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(b"x" * 100_000)
    expected = hashlib.sha256(b"x" * 100_000).hexdigest()
    assert sealed.hashes(ConfinedPath(tmp_path), ["a"]) == {"a": expected}
    assert not list(sealed.changed(ConfinedPath(tmp_path), {"a": expected}))


def test_folders_are_set_aside_under_names_that_are_free(tmp_path: Path) -> None:
    folder = ConfinedPath(tmp_path) / "key-hash"
    (tmp_path / ".key-hash.aside-2").write_text("a file")
    for number in (1, 3):
        folder.make_folder()
        (folder.path / "content").write_text(str(number))
        assert sealed.set_aside(folder).name == f".key-hash.aside-{number}"
        assert (tmp_path / f".key-hash.aside-{number}/content").read_text() == str(number)
        assert not folder.exists()


def test_a_lock_that_is_a_link_empties_nothing(tmp_path: Path) -> None:
    precious = tmp_path / "precious"
    precious.write_text("mine")
    (tmp_path / ".key.lock").symlink_to(precious)
    lock = ConfinedPath(tmp_path) / ".key.lock"
    with pytest.raises(OSError, match="key"), sealed.lock(lock):
        pass
    assert precious.read_text() == "mine"
