"""Tests of attempts at a cell: what a new one keeps of those before it."""

from __future__ import annotations

import errno
import os
import re
import shutil
from pathlib import Path

import pytest

from tests.store.cells import begun, identity
from xrgs.errors import UnreadableError
from xrgs.safeio.atomic import write_json
from xrgs.safeio.files import list_names, sync_tree
from xrgs.store import attempts
from xrgs.store.attempts import begin_attempt, plan_cell
from xrgs.store.cell_folder import CellFolder, CellState

BEGUN = ["config.json", "identity.json", "log.txt"]


@pytest.mark.parametrize("failed", [False, True])
def test_beginning_a_stopped_cell_keeps_its_checkpoint_and_no_result(
    stopped: CellFolder, failed: bool
) -> None:
    if failed:
        stopped.fail("its process was ended by SIGKILL")
        assert not stopped.progress.exists()
    else:
        assert stopped.state().name == "unfinished"
        assert "resumes from its checkpoint" in stopped.state().reason
    conf = stopped.config()
    conf.store = "elsewhere"
    plan_cell(stopped, conf, identity())
    assert begin_attempt(stopped)
    assert list_names(stopped.path) == ["checkpoint.npz", *BEGUN]
    assert stopped.checkpoint.read_bytes() == b"state"
    assert (stopped.path / "log.txt").read_text() == "begun\n"
    assert stopped.config().store == "elsewhere"
    assert list_names(stopped.path.parent) == ["abc"]


def steps(events: list[str]) -> list[str]:
    """Events of the disk without the random ends of hidden names."""
    return [re.sub(r"(\.(?:new|old))-\w+", r"\1", event) for event in events]


def test_a_new_attempt_is_on_the_disk_before_it_has_the_name_of_the_old_one(
    stopped: CellFolder, disk_events: list[str]
) -> None:
    """A power failure leaves the old one or the new one, whole, and no removed one as a third."""
    assert begin_attempt(stopped)
    events = steps(disk_events)
    named = events.index("rename abc to .abc.old")
    files = ("checkpoint.npz", "config.json", "identity.json", "log.txt", ".abc.new")
    assert sorted(events[:named]) == sorted(f"sync {name}" for name in files)
    assert events[named:] == [
        *("rename abc to .abc.old", "sync cells", "rename .abc.new to abc", "sync cells"),
        *("rename .abc.old to .abc.new", "sync cells"),
    ]


def test_a_cell_killed_before_its_first_checkpoint_leaves_no_folder_aside(tmp_path: Path) -> None:
    folder = begun(CellFolder(tmp_path / "cells" / "abc"))
    (folder.path / "splats.ply").write_text("of the attempt that was killed")
    (tmp_path / "mine").write_text("kept")
    (folder.path / "linked").symlink_to(tmp_path / "mine")
    with (folder.path / "log.txt").open("ab") as log:  # its process still writes
        log.write(b"before")
        log.flush()
        begun(folder)
        log.write(b"after")
    assert (folder.path / "log.txt").read_text() == "before"
    assert list_names(folder.path) == BEGUN
    assert list_names(folder.path.parent) == ["abc"]
    assert (tmp_path / "mine").read_text() == "kept"


def test_a_corrupt_cell_is_set_aside(done: CellFolder, disk_events: list[str]) -> None:
    (done.path / "scores.csv").write_text("view\n")
    assert begin_attempt(done)
    assert list_names(done.path) == BEGUN
    assert (done.path.with_name("abc.aside-1") / "scores.csv").read_text() == "view\n"
    assert steps(disk_events)[-2:] == ["rename .abc.old to abc.aside-1", "sync cells"]


def test_a_failed_cell_without_checkpoint_is_set_aside_with_its_error(tmp_path: Path) -> None:
    folder = begun(CellFolder(tmp_path / "cells" / "abc"))
    for aside in (1, 2):
        folder.fail(f"out of luck {aside}")
        begun(folder)
        assert folder.state().name == "unfinished"
        error = folder.path.with_name(f"abc.aside-{aside}") / "error.txt"
        assert error.read_text() == f"out of luck {aside}\n"


def test_a_process_that_lost_its_cell_writes_into_its_own_attempt_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its working directory is its attempt, whatever folder has the cell's name."""
    folder = begun(CellFolder(tmp_path / "cells" / "abc"))
    monkeypatch.chdir(folder.path)
    first = CellFolder(Path(), folder.id)
    write_json(first.path / "summary.json", {})
    monkeypatch.setattr(attempts, "_remove", lambda _: None)  # as where the process keeps a file
    begun(folder)
    first.fail("out of luck")
    (first.path / "scores.csv").write_text("view\n")
    assert first.state().name == "failed"
    assert folder.state().name == "unfinished"
    assert list_names(folder.path) == BEGUN


def test_a_process_that_lost_the_lease_meanwhile_changes_nothing(
    stopped: CellFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = list_names(stopped.path)
    synced: list[Path] = []

    def is_owner() -> bool:
        return not synced  # the lease is lost while the new folder is synced

    def sync(folder: Path) -> None:
        synced.append(folder)
        sync_tree(folder)

    monkeypatch.setattr(attempts, "sync_tree", sync)
    assert is_owner()
    assert not begin_attempt(stopped, is_owner)
    assert list_names(stopped.path) == before
    assert list_names(stopped.path.parent) == ["abc"]


@pytest.mark.parametrize("in_place", [False, True])
def test_what_a_killed_process_left_of_other_attempts_is_used_or_removed(
    stopped: CellFolder, in_place: bool
) -> None:
    home = stopped.path.parent
    shutil.copytree(stopped.path, home / ".abc.new-1")
    if in_place:
        shutil.copytree(stopped.path, home / ".abc.old-1")
        stopped.checkpoint.write_bytes(b"newer")
    else:
        stopped.path.rename(home / ".abc.old-1")
    (home / ".abcd.old-1").mkdir()  # of another cell
    begun(stopped)
    assert stopped.checkpoint.read_bytes() == (b"newer" if in_place else b"state")
    assert list_names(home) == [".abcd.old-1", "abc"]


def test_a_cell_that_can_not_be_read_now_is_not_begun(
    done: CellFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    failed = CellState("failed", "status.json: Input/output error", unreadable=True)
    monkeypatch.setattr(CellFolder, "state", lambda _: failed)
    with pytest.raises(UnreadableError, match=r"abc: status\.json: Input/output error"):
        begin_attempt(done)
    assert list_names(done.path.parent) == ["abc"]
    assert done.status_file.exists()


def test_a_beginning_that_fails_leaves_the_cell_as_it_was(
    stopped: CellFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    before = list_names(stopped.path)
    monkeypatch.setattr(attempts, "sync_tree", full)
    with pytest.raises(OSError, match="No space left"):
        begin_attempt(stopped)
    assert list_names(stopped.path) == before
    assert list_names(stopped.path.parent) == ["abc"]
