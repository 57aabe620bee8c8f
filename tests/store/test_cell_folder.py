"""Tests of a cell's folder: its state and its results."""

from __future__ import annotations

import re

import pytest

from tests.store.cells import SCORES, SUMMARY, identity
from xrgs.safeio.atomic import write_json
from xrgs.store.attempts import plan_cell
from xrgs.store.cell_folder import CellFolder


def test_a_finished_cell_is_done_and_gives_back_what_was_written(done: CellFolder) -> None:
    assert done.state().name == "done"
    assert done.summary() == SUMMARY
    assert done.identity() == identity()
    assert done.config().scene.name == "motorcycle"
    assert done.history()["loss"].tolist() == [0.5]


def test_every_result_is_on_the_disk_before_a_cell_is_done(
    done: CellFolder, disk_events: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """And the checkpoint is removed after that: a power failure costs no step."""
    results = {f"sync {path.name}" for path in done.path.rglob("*")} - {"sync status.json"}
    done.status_file.unlink()
    monkeypatch.setattr(CellFolder, "drop_checkpoint", lambda _: disk_events.append("drop"))
    done.finish(["a", "b"], {})
    named = disk_events.index("name status.json")
    assert results | {f"sync {done.id}"} <= set(disk_events[: named - 1])
    assert disk_events[named - 1].startswith("sync .status.json.")
    assert disk_events[named + 1 :] == [f"sync {done.id}", "drop"]


def test_the_reason_is_on_the_disk_before_a_cell_has_failed(
    done: CellFolder, disk_events: list[str]
) -> None:
    done.fail("out of luck")
    assert [re.sub(r"\.\d+-\w+$", "", event) for event in disk_events] == [
        *("sync .error.txt", "name error.txt", "sync abc"),
        *("sync .status.json", "name status.json", "sync abc"),
    ]
    assert done.state().reason == "out of luck"


def test_a_cell_without_status_is_unfinished_planned_or_absent(done: CellFolder) -> None:
    done.status_file.unlink()
    assert done.state().name == "unfinished"
    other = CellFolder(done.path.with_name("other"))
    assert other.state().name == "absent"
    plan_cell(other, done.config(), identity())
    assert other.state().name == "planned"


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("scores.csv", SCORES.replace("20.5", "99.5")),
        ("config.json", '{"seed": 1}'),
        ("identity.json", '{\n "seed": 1\n}\n'),
        ("history.csv", "step,view,gaussians,loss\n0,c,7,0.7\n"),  # of the same size
        ("renders/a.png", "12345"),
        ("status.json", "{"),
        ("status.json", '{"state": "finished"}'),
    ],
)
def test_a_cell_that_was_changed_is_corrupt(done: CellFolder, name: str, content: str) -> None:
    (done.path / name).write_text(content)
    assert done.state().name == "corrupt"
    assert done.state().reason


@pytest.mark.parametrize("views", [["a"], ["b", "a"]])
def test_scores_of_other_views_than_planned_are_corrupt(done: CellFolder, views: list[str]) -> None:
    done.finish(views, {})
    assert done.state().name == "corrupt"
    assert "one row for each view" in done.state().reason
    assert done.state(verify=False).name == "done"  # sizes alone do not show it


def test_the_state_of_a_cell_in_training_names_its_owner(done: CellFolder) -> None:
    assert done.state(owner="process 7 on host").name == "done"
    done.status_file.unlink()
    assert done.state(owner="process 7 on host").reason == "by process 7 on host"
    write_json(
        done.progress, {"what": "training", "unit": "step", "done": 5, "total": 10, "rate": None}
    )
    state = done.state(owner="process 7 on host")
    assert (state.name, state.reason) == ("running", "by process 7 on host: training 5 of 10 steps")


def test_a_finished_cell_has_no_checkpoint(stopped: CellFolder) -> None:
    stopped.finish(["a", "b"], {})
    stopped.progress.unlink()  # of a process that has ended: no result
    assert stopped.state().name == "done"
    assert not stopped.checkpoint.exists()
    stopped.checkpoint.write_bytes(b"killed before it was removed")
    assert stopped.state().name == "done"


def test_new_scores_of_a_done_cell_are_part_of_it(done: CellFolder) -> None:
    (done.path / "scores.csv").write_text(SCORES.replace("20.5", "21.5"))
    done.rescored(["scores.csv"], {"psnr": "4567"})
    assert done.state().name == "done"
    assert done.status().scored_by == {"psnr": "4567"}


def test_files_that_the_system_made_are_no_results(done: CellFolder) -> None:
    # NFS keeps a file under such a name while somebody still reads it, and then removes it.
    files = done.status().files
    kept = done.path / "renders" / ".nfs000000000123"
    kept.write_text("an older file that is open")
    assert done.verify() == []
    done.finish(["a", "b"], {"psnr": "0123"})
    kept.unlink()
    assert done.status().files == files
    assert done.state().name == "done"
