"""Tests of a cell's folder: its state, and what is kept of earlier attempts."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from xrgs.experiment.cell_folder import CellFolder
from xrgs.safeio.atomic import write_json


@pytest.fixture
def done(tmp_path: Path) -> CellFolder:
    """The folder of a finished cell with two test views."""
    (tmp_path / "cells").mkdir()
    folder = CellFolder(tmp_path / "cells" / "abc")
    folder.begin({"seed": 0}, {"seed": 0})
    (folder.path / "scores.csv").write_text("view,psnr,ssim,lpips\na,20.5,0.75,\nb,30.0,0.5,\n")
    (folder.path / "history.csv").write_text("step,loss\n0,0.5\n")
    write_json(folder.path / "summary.json", {"gaussians": 7})
    (folder.path / "renders").mkdir()
    (folder.path / "renders" / "a.png").write_bytes(b"1234")
    folder.finish(["a", "b"], protocol=1)
    return folder


def test_a_finished_cell_is_done_and_gives_back_what_was_written(done: CellFolder) -> None:
    assert done.state().name == "done"
    assert done.summary() == {"gaussians": 7}
    assert done.identity() == {"seed": 0}
    assert done.history()["loss"].tolist() == [0.5]


def test_declaring_a_cell_done_twice_keeps_it_done(done: CellFolder) -> None:
    done.finish(["a", "b"], protocol=1)
    assert done.state().name == "done"


def test_a_cell_without_status_is_unfinished_and_an_absent_one_absent(done: CellFolder) -> None:
    (done.path / "status.json").unlink()
    assert done.state().name == "unfinished"
    assert CellFolder(done.path.with_name("other")).state().name == "absent"


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("scores.csv", "view,psnr,ssim,lpips\na,99.9,0.75,\nb,30.0,0.5,\n"),
        ("scores.csv", "view,psnr,ssim,lpips\na,20.5,0.75,\n"),
        ("config.json", '{"seed": 1}'),
        ("identity.json", '{\n "seed": 1\n}\n'),
        ("history.csv", "step,loss\n0,0.7\n"),  # of the same size, as a report would read it
        ("summary.json", '{\n "gaussians": 8\n}\n'),
        ("renders/a.png", "12345"),
        ("status.json", "{"),
        ("status.json", '{"state": "done"}'),
        ("status.json", "[]"),
    ],
)
def test_a_cell_that_was_tampered_with_is_corrupt(
    done: CellFolder, name: str, content: str
) -> None:
    (done.path / name).write_text(content)
    assert done.state().name == "corrupt"
    assert done.state().reason


@pytest.mark.parametrize("views", [["a"], ["a", "c"], ["b", "a"], ["a", "b", "b"]])
def test_scores_of_other_views_than_planned_are_corrupt(done: CellFolder, views: list[str]) -> None:
    done.finish(views, protocol=1)
    assert done.state().name == "corrupt"
    assert "one row for each view" in done.state().reason
    assert done.state(verify=False).name == "done"  # sizes alone do not show it


def test_the_state_of_a_cell_in_training_names_its_owner(done: CellFolder) -> None:
    assert done.running("process 7 on host").reason == "by process 7 on host"
    write_json(
        done.progress,
        {"what": "training", "unit": "step", "done": 5, "total": 10, "rate": None},
    )
    state = done.running("process 7 on host")
    assert (state.name, state.reason) == ("running", "by process 7 on host: training 5 of 10 steps")


def test_a_missing_file_is_named(done: CellFolder) -> None:
    (done.path / "renders" / "a.png").unlink()
    state = done.state()
    assert state.name == "corrupt"
    assert "renders/a.png" in state.reason


def test_a_failed_cell_says_why(done: CellFolder) -> None:
    done.fail("out of luck")
    assert done.state().name == "failed"
    assert done.state().reason == "out of luck"


def test_beginning_another_cell_sets_the_old_folder_aside(done: CellFolder) -> None:
    done.begin({"seed": 1}, {"seed": 1})
    done.begin({"seed": 2}, {"seed": 2})
    assert done.state().name == "unfinished"
    aside = sorted(path.name for path in done.path.parent.iterdir())
    assert aside == ["abc", "abc.aside-1", "abc.aside-2"]
    assert CellFolder(done.path.with_name("abc.aside-1")).identity() == {"seed": 0}


@pytest.fixture
def stopped(done: CellFolder) -> CellFolder:
    """A folder of a try that was stopped after a checkpoint, with all that may lie about."""
    (done.path / "status.json").unlink()
    done.checkpoint.path.write_bytes(b"state")
    (done.path / "log.txt").write_text("begun\n")
    (done.path / ".checkpoint.npz.1-abcd").write_bytes(b"half")
    done.progress.path.write_text("{}")
    return done


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
    stopped.begin({"seed": 0, "store": "elsewhere"}, {"seed": 0})
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
    folder.begin({"seed": 0}, {"seed": 0})
    (folder.path / "log.txt").write_text("begun\n")
    (folder.path / "splats.ply").write_text("of the try that was killed")
    folder.begin({"seed": 0}, {"seed": 0})
    assert sorted(entry.name for entry in folder.path.iterdir()) == [
        "config.json",
        "identity.json",
        "log.txt",
    ]
    assert [entry.name for entry in folder.path.parent.iterdir()] == ["abc"]


def test_a_failed_cell_without_checkpoint_is_set_aside_with_its_error(tmp_path: Path) -> None:
    (tmp_path / "cells").mkdir()
    folder = CellFolder(tmp_path / "cells" / "abc")
    folder.begin({"seed": 0}, {"seed": 0})
    folder.fail("out of luck")
    folder.begin({"seed": 0}, {"seed": 0})
    assert "out of luck" in (tmp_path / "cells" / "abc.aside-1" / "error.txt").read_text()


def test_beginning_another_cell_does_not_take_the_checkpoint(stopped: CellFolder) -> None:
    stopped.begin({"seed": 0}, {"seed": 0, "code": {"train.py": "changed"}})
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
    stopped.begin({"seed": 0}, {"seed": 0})
    assert not stopped.checkpoint.exists()


def test_what_a_link_points_to_is_not_cleared(stopped: CellFolder, tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "file").write_text("kept")
    (stopped.path / "linked").symlink_to(tmp_path / "mine")
    stopped.begin({"seed": 0}, {"seed": 0})
    assert not (stopped.path / "linked").exists()
    assert (tmp_path / "mine" / "file").read_text() == "kept"


def test_a_finished_cell_has_no_checkpoint(stopped: CellFolder) -> None:
    stopped.finish(["a", "b"], protocol=1)
    stopped.progress.unlink()  # of a process that is no more: no part of the result
    assert stopped.state().name == "done"
    assert not stopped.checkpoint.exists()
    stopped.checkpoint.path.write_bytes(b"killed before it was removed")
    assert stopped.state().name == "done"
