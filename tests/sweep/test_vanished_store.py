"""Tests that a store which vanishes is noticed, and that nothing of it reappears."""

from __future__ import annotations

import contextlib
import errno
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from xrgs.store.store import Store, StoreGoneError


def rename(store: Path) -> None:
    store.rename(store.with_name("moved"))


def delete(store: Path) -> None:
    rename(store)
    moved = store.with_name("moved")
    while moved.exists():
        # A process may write a file between the listing of a folder and its removal.
        with contextlib.suppress(OSError):
            shutil.rmtree(moved)


def unmount(store: Path) -> None:
    """Leave an empty folder, as the place where a disk was mounted."""
    rename(store)
    store.mkdir()


@pytest.mark.parametrize("vanishes", [rename, delete, unmount])
def test_a_store_that_was_moved_is_gone_and_says_where_its_cells_are(
    store: Store, vanishes: Callable[[Path], None]
) -> None:
    store.check_not_gone()
    vanishes(store.path)
    assert store.is_gone
    with pytest.raises(StoreGoneError, match=r"no longer there .*finished cells are where"):
        store.check_not_gone()


def test_a_store_that_can_not_be_looked_at_now_is_not_gone(
    store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(path: Path, **_: object) -> os.stat_result:
        raise OSError(errno.ESTALE, os.strerror(errno.ESTALE), str(path))

    monkeypatch.setattr(Path, "stat", fail)
    store.check_not_gone()
