"""Tests of attempts at a cell: what a new one keeps of those before it."""

from __future__ import annotations

import errno
import json
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from xrgs.errors import UnreadableError
from xrgs.experiment.attempts import begin_attempt
from xrgs.experiment.cell_folder import CellFolder, CellState
from xrgs.safeio.atomic import write_json
from xrgs.safeio.confined import ConfinedPath, ReplacedError


def test_beginning_another_cell_sets_the_old_folder_aside(done: CellFolder) -> None:
    begin_attempt(done, {"seed": 1}, {"seed": 1})
    begin_attempt(done, {"seed": 2}, {"seed": 2})
    assert done.state().name == "unfinished"
    aside = sorted(path.name for path in done.path.parent.iterdir())
    assert aside == ["abc", "abc.aside-1", "abc.aside-2"]
    assert CellFolder(done.path.with_name("abc.aside-1")).identity() == {"seed": 0}


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
    begin_attempt(stopped, {"seed": 0, "store": "elsewhere"}, {"seed": 0})
    assert sorted(entry.name for entry in stopped.path.iterdir()) == [
        "checkpoint.npz",
        "config.json",
        "identity.json",
        "log.txt",
    ]
    assert stopped.checkpoint.read_bytes() == b"state"
    assert json.loads((stopped.path / "config.json").read_text())["store"] == "elsewhere"
    assert [entry.name for entry in stopped.path.parent.iterdir()] == ["abc"]


def test_a_cell_killed_before_its_first_checkpoint_leaves_no_folder_aside(tmp_path: Path) -> None:
    folder = CellFolder(tmp_path / "cells" / "abc")
    begin_attempt(folder, {"seed": 0}, {"seed": 0})
    (folder.path / "log.txt").write_text("begun\n")
    (folder.path / "splats.ply").write_text("of the try that was killed")
    begin_attempt(folder, {"seed": 0}, {"seed": 0})
    assert sorted(entry.name for entry in folder.path.iterdir()) == [
        "config.json",
        "identity.json",
        "log.txt",
    ]
    assert [entry.name for entry in folder.path.parent.iterdir()] == ["abc"]


def test_a_failed_cell_without_checkpoint_is_set_aside_with_its_error(tmp_path: Path) -> None:
    (tmp_path / "cells").mkdir()
    folder = CellFolder(tmp_path / "cells" / "abc")
    begin_attempt(folder, {"seed": 0}, {"seed": 0})
    folder.fail("out of luck")
    begin_attempt(folder, {"seed": 0}, {"seed": 0})
    assert "out of luck" in (tmp_path / "cells" / "abc.aside-1" / "error.txt").read_text()


def test_beginning_another_cell_does_not_take_the_checkpoint(stopped: CellFolder) -> None:
    begin_attempt(stopped, {"seed": 0}, {"seed": 0, "code": {"train.py": "changed"}})
    assert not stopped.checkpoint.exists()
    aside = CellFolder(stopped.path.with_name("abc.aside-1"))
    assert aside.checkpoint.read_bytes() == b"state"


@pytest.mark.parametrize("identity", [None, "{", "[]"])
def test_beginning_a_cell_of_unknown_identity_does_not_take_the_checkpoint(
    stopped: CellFolder, identity: str | None
) -> None:
    file = stopped.path / "identity.json"
    file.unlink()
    if identity is not None:
        file.write_text(identity)
    begin_attempt(stopped, {"seed": 0}, {"seed": 0})
    assert not stopped.checkpoint.exists()


def test_what_a_link_points_to_is_not_cleared(stopped: CellFolder, tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "file").write_text("kept")
    (stopped.path / "linked").symlink_to(tmp_path / "mine")
    begin_attempt(stopped, {"seed": 0}, {"seed": 0})
    assert not (stopped.path / "linked").exists()
    assert (tmp_path / "mine" / "file").read_text() == "kept"


def test_an_attempt_writes_nothing_once_another_has_begun(tmp_path: Path) -> None:
    folder = CellFolder(tmp_path / "cells" / "abc")
    first = begin_attempt(folder, {"seed": 0}, {"seed": 0})
    write_json(first.folder / "summary.json", {})
    second = begin_attempt(folder, {"seed": 0}, {"seed": 0})
    writes: list[Callable[[], None]] = [
        lambda: write_json(first.folder / "summary.json", {}),
        lambda: first.fail("out of luck"),
        lambda: first.finish([], 1),
        first.drop_checkpoint,
    ]
    for write in writes:
        with pytest.raises(ReplacedError, match="it was replaced by another folder"):
            write()
    assert first.state().name == "unknown"
    assert second.state().name == folder.state().name == "unfinished"
    assert second.folder.names() == ["config.json", "identity.json"]


def test_a_log_that_is_still_written_to_is_not_that_of_the_next_attempt(tmp_path: Path) -> None:
    folder = CellFolder(tmp_path / "cells" / "abc")
    first = begin_attempt(folder, {"seed": 0}, {"seed": 0})
    with (first.folder / "log.txt").append() as log:
        log.write(b"before")
        log.flush()
        second = begin_attempt(folder, {"seed": 0}, {"seed": 0})
        log.write(b"after")
    assert (second.path / "log.txt").read_text() == "before"


def test_a_cell_that_another_process_begins_meanwhile_is_left_to_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The first process was suspended while it began: the second has even finished the cell."""
    folder, sync = CellFolder(tmp_path / "cells" / "abc"), ConfinedPath.sync_tree
    begin_attempt(folder, {"seed": 0}, {"seed": 0})

    def overtaken(new: ConfinedPath) -> None:
        sync(new)
        monkeypatch.setattr(ConfinedPath, "sync_tree", sync)
        second = begin_attempt(folder, {"seed": 0}, {"seed": 0})
        (second.path / "scores.csv").write_text("view\na\n")
        second.finish(["a"], 1)

    monkeypatch.setattr(ConfinedPath, "sync_tree", overtaken)
    with pytest.raises(OSError, match="abc"):
        begin_attempt(folder, {"seed": 0}, {"seed": 0})
    assert folder.state().name == "done"
    assert [entry.name for entry in folder.path.parent.iterdir()] == ["abc"]


@pytest.mark.parametrize("in_place", [False, True])
def test_what_a_killed_process_left_of_other_attempts_is_used_or_removed(
    stopped: CellFolder, in_place: bool
) -> None:
    home = stopped.path.parent
    shutil.copytree(stopped.path, home / ".abc.new-1")
    if in_place:
        shutil.copytree(stopped.path, home / ".abc.old-1")
        stopped.checkpoint.path.write_bytes(b"newer")
    else:
        stopped.path.rename(home / ".abc.old-1")
    (home / ".abcd.old-1").mkdir()  # of another cell
    attempt = begin_attempt(stopped, {"seed": 0}, {"seed": 0})
    assert attempt.checkpoint.read_bytes() == (b"newer" if in_place else b"state")
    assert sorted(entry.name for entry in home.iterdir()) == [".abcd.old-1", "abc"]


def test_a_cell_that_can_not_be_read_now_is_not_begun(
    done: CellFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    unknown = CellState("unknown", "it can't be read now: Input/output error")
    monkeypatch.setattr(CellFolder, "state", lambda _: unknown)
    with pytest.raises(UnreadableError, match="abc: it can't be read now: Input/output error"):
        begin_attempt(done, {"seed": 0}, {"seed": 0})
    assert [entry.name for entry in done.path.parent.iterdir()] == ["abc"]
    assert (done.path / "status.json").exists()


def test_a_beginning_that_fails_leaves_the_cell_as_it_was(
    stopped: CellFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(_: object) -> None:
        raise OSError(errno.ENOSPC, "no room")

    before = sorted(stopped.path.iterdir())
    monkeypatch.setattr(ConfinedPath, "sync_tree", full)
    with pytest.raises(OSError, match="no room"):
        begin_attempt(stopped, {"seed": 0}, {"seed": 0})
    assert sorted(stopped.path.iterdir()) == before
    assert [entry.name for entry in stopped.path.parent.iterdir()] == ["abc"]
