"""Tests that a running sweep is read from the files that its cells write, with any launcher."""

from __future__ import annotations

import errno
import io
import time
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path

import pytest

from xrgs.config import Conf
from xrgs.experiment.attempts import begin_attempt
from xrgs.experiment.cell_folder import CellState
from xrgs.experiment.store import Store
from xrgs.runtime.progress import Progress
from xrgs.safeio.atomic import write_json
from xrgs.sweep import monitor as monitor_module
from xrgs.sweep.axes import CellSpec
from xrgs.sweep.monitor import SweepMonitor
from xrgs.sweep.plan import PlannedCell
from xrgs.sweep.snapshot import RunningCell


class Cells:
    """PlannedCell cells, and the files of those that are begun."""

    def __init__(self, store: Store, conf: Conf) -> None:
        self.store = store
        self.conf = conf

    def plan(self, name: str, state: str = "absent", seconds: float | None = None) -> PlannedCell:
        spec = CellSpec(name, "", (), ())
        return PlannedCell(
            spec, self.conf, "v", {"name": name}, name, CellState(state), seconds=seconds
        )

    def begin(self, name: str) -> None:
        begin_attempt(self.store.cell(name), {}, {"name": name})

    def step(self, name: str, done: int, rate: float | None, what: str = "training") -> None:
        unit = "step" if what == "training" else "view"
        now = Progress(what, unit, done, 100, rate)
        write_json(self.store.cell(name).progress, asdict(now))

    def finish(self, name: str) -> None:
        folder = self.store.cell(name)
        folder.progress.unlink(missing_ok=True)
        (folder.path / "scores.csv").write_text("view\na\n")
        folder.finish(["a"], 1)


@pytest.fixture
def cells(compose: Callable[..., Conf], tmp_path: Path) -> Cells:
    store = Store(tmp_path / "s")
    store.prepare()
    return Cells(store, compose("train.steps=100"))


def test_states_are_read_from_the_cells_files_alone(cells: Cells) -> None:
    cells.begin("failed")
    cells.store.cell("failed").fail("it raised")
    monitor = SweepMonitor(cells.store.cells_folder)
    names = ("a", "b", "c")
    plan = [cells.plan(name) for name in names] + [
        cells.plan("failed", "failed"),
        cells.plan("done", "done"),
        replace(cells.plan("none"), cell_id=None, error="no variant"),
    ]
    monitor.watch(plan)
    assert str(monitor.snapshot()) == "1 of 6 cells done, 2 failed"
    cells.begin("a")
    cells.step("a", 20, 10.0)
    snapshot = monitor.snapshot()
    assert [cell.cell.cell_id for cell in snapshot.running] == ["a"]
    # 80 steps of a, and 100 of b and of c, which nothing else is known of
    assert str(snapshot) == (
        "1 of 6 cells done, 2 failed, training 20 of 100 steps, 10 steps/s, ~28 s left"
    )
    cells.begin("b")
    cells.step("b", 50, 5.0)
    # 8 s and 10 s, and c at their mean pace 15 s: by two at once
    assert str(monitor.snapshot()).endswith("2 failed, 2 in training, 15 steps/s, ~16 s left")
    cells.finish("a")
    cells.store.cell("b").fail("it raised")
    cells.begin("c")
    assert str(monitor.snapshot()).startswith("2 of 6 cells done, 3 failed, ~15 s left")


def test_another_sweeps_cell_is_waited_for(cells: Cells) -> None:
    monitor = SweepMonitor(cells.store.cells_folder)
    monitor.watch([cells.plan("a"), cells.plan("b", "running")])
    cells.begin("b")
    cells.step("b", 90, 0.1)
    assert str(monitor.snapshot()) == "0 of 2 cells done, 1 in another sweep"
    cells.begin("a")
    cells.step("a", 0, 10.0)
    assert str(monitor.snapshot()).endswith("~2 min left")  # b's ten steps, not a's ten seconds
    cells.finish("b")
    assert monitor.snapshot().done == 1


def test_a_cell_that_is_trained_again_has_not_ended_before_it_does(cells: Cells) -> None:
    for name in ("failed", "corrupt"):
        cells.begin(name)
        cells.store.cell(name).fail("once")
    conf = replace(cells.conf, retry="failed")
    plan = [replace(cells.plan(name, name), conf=conf) for name in ("failed", "corrupt")]
    monitor = SweepMonitor(cells.store.cells_folder)
    monitor.watch(plan)
    assert str(monitor.snapshot()) == "0 of 2 cells done"
    cells.begin("failed")
    cells.store.cell("failed").fail("twice")
    cells.begin("corrupt")
    cells.finish("corrupt")
    assert str(monitor.snapshot()) == "1 of 2 cells done, 1 failed"
    monitor.watch([replace(cell, state=CellState("failed")) for cell in plan])
    assert str(monitor.snapshot()) == "1 of 2 cells done, 1 failed"


def test_files_that_a_killed_process_left_are_no_sign_of_life(
    cells: Cells, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("before", "now"):
        cells.begin(name)
    cells.step("before", 5, 1.0)
    monitor = SweepMonitor(cells.store.cells_folder)
    monitor.watch([cells.plan("before", "unfinished"), cells.plan("now")])
    assert not monitor.snapshot().running
    cells.step("now", 5, 1.0)
    assert len(monitor.snapshot().running) == 1
    monkeypatch.setattr(monitor_module, "_SILENT_S", 0.0)
    assert not monitor.snapshot().running


def test_past_cells_decide_at_first_and_the_own_pace_in_the_end(cells: Cells) -> None:
    cell = cells.plan("a", seconds=100.0)

    def left(done: int, rate: float | None, what: str = "training", unit: str = "step") -> float:
        found = RunningCell(cell, Progress(what, unit, done, 100, rate)).left_s
        assert found is not None
        return found

    assert left(0, None) == left(0, 50.0) == 100
    assert left(50, 10.0) == pytest.approx((50 + 5) / 2)
    assert left(99, 10.0) == pytest.approx(0.1, abs=0.01)
    assert left(0, None, "loading", "view") == 100
    assert left(10, 9.0, "evaluating", "view") == pytest.approx(10)


def test_a_log_has_a_line_when_a_cell_ends_and_the_last_at_the_end(
    cells: Cells, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(monitor_module, "_POLL_S", 0.01)
    with SweepMonitor(cells.store.cells_folder) as monitor:
        monitor.watch([cells.plan("a"), cells.plan("b"), cells.plan("old", "done")])
        for name in ("a", "b"):
            cells.begin(name)
            cells.step(name, 1, 1.0)
            time.sleep(0.1)
            cells.finish(name)
            if name == "a":
                time.sleep(0.5)
    output = capsys.readouterr().err
    assert "\r" not in output
    assert [line[:18] for line in output.splitlines()] == [
        "2 of 3 cells done,",
        "3 of 3 cells done",
    ]


def test_nothing_is_shown_of_a_finished_plan(
    cells: Cells, capsys: pytest.CaptureFixture[str]
) -> None:
    with SweepMonitor(cells.store.cells_folder) as monitor:
        monitor.watch([cells.plan("a", "done"), cells.plan("b", "failed")])
    with SweepMonitor(cells.store.cells_folder):
        pass
    assert capsys.readouterr().err == ""


def test_a_terminal_shows_one_line_which_is_removed_at_the_end(
    cells: Cells, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Terminal(io.StringIO):
        def isatty(self) -> bool:
            return True

    terminal = Terminal()
    monkeypatch.setattr("sys.stderr", terminal)
    monkeypatch.setattr(monitor_module, "_POLL_S", 0.01)
    with SweepMonitor(cells.store.cells_folder) as monitor:
        monitor.watch([cells.plan("a"), cells.plan("b")])
        cells.begin("a")
        cells.step("a", 50, 1.0)
        end = time.monotonic() + 60  # on a busy machine the monitor's thread may wait for its turn
        while " 25%|" not in terminal.getvalue():
            assert time.monotonic() < end
            time.sleep(0.01)
        cells.finish("a")
    output = terminal.getvalue()
    assert "0 of 2 cells done, training 50 of 100 steps, 1 steps/s" in output
    *_, last = output.split("\r")
    assert last.startswith("\x1b[K1 of 2 cells done")
    assert output.count("\n") == 1


def test_a_status_that_can_not_be_read_is_read_again(
    cells: Cells, sick: Callable[[str, int], None]
) -> None:
    monitor = SweepMonitor(cells.store.cells_folder)
    monitor.watch([cells.plan("a")])
    cells.begin("a")
    cells.finish("a")
    sick("status.json", errno.EIO)
    assert str(monitor.snapshot()) == "0 of 1 cells done"
    sick("", 0)
    assert str(monitor.snapshot()) == "1 of 1 cells done"


def test_cells_that_were_seen_to_end_still_count_when_the_store_is_gone(cells: Cells) -> None:
    monitor = SweepMonitor(cells.store.cells_folder)
    monitor.watch([cells.plan("a"), cells.plan("b")])
    cells.begin("a")
    cells.finish("a")
    assert str(monitor.snapshot()) == "1 of 2 cells done"
    cells.store.path.rename(cells.store.path.with_name("gone"))
    assert str(monitor.snapshot()) == "1 of 2 cells done"


def test_a_store_out_of_reach_is_read_again(cells: Cells) -> None:
    monitor = SweepMonitor(cells.store.cells_folder)
    monitor.watch([cells.plan("a")])
    gone = cells.store.path.with_name("gone")
    cells.store.path.rename(gone)
    assert str(monitor.snapshot()) == "0 of 1 cells done"
    gone.rename(cells.store.path)
    cells.begin("a")
    cells.finish("a")
    assert str(monitor.snapshot()) == "1 of 1 cells done"


def test_what_this_sweep_s_cells_took_tells_of_those_that_wait(
    cells: Cells, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two at once that take three times as long as past cells did, and two more of them."""
    now = 1000.0
    monkeypatch.setattr(time, "monotonic", lambda: now)
    monitor = SweepMonitor(cells.store.cells_folder)
    monitor.watch([cells.plan(name, seconds=100.0) for name in ("a", "b", "c", "d")])
    for name in ("a", "b"):
        cells.begin(name)
        cells.step(name, 0, None)
    assert monitor.snapshot().left_s == pytest.approx(200)
    now += 150
    for name in ("a", "b"):
        cells.step(name, 50, 1 / 3)
    # Each of the four takes almost 300 s in all, of which 150 s are over for two.
    assert monitor.snapshot().left_s == pytest.approx(450, rel=0.15)
    now += 150
    for name in ("a", "b"):
        cells.finish(name)
    assert monitor.snapshot().left_s == pytest.approx(300, rel=0.1)  # two at once, as before


def test_a_cell_that_is_evaluated_amid_its_steps_is_not_at_their_end(
    cells: Cells, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A cell that takes as long as was expected: a second for a step, and ten beside them."""
    last = 0
    monkeypatch.setattr(time, "monotonic", lambda: 1000.0 + last)
    conf = replace(cells.conf, train=replace(cells.conf.train, evaluate_every=40))
    monitor = SweepMonitor(cells.store.cells_folder)
    plan = replace(cells.plan("a", seconds=110.0), conf=conf, scoring_s=10.0)
    monitor.watch([plan])
    cells.begin("a")
    for last, after in ((39, 40), (79, 80), (97, 100)):
        cells.step("a", last, 1.0)
        shown = monitor.snapshot().running[0]
        cells.step("a", 2, 0.5, "evaluating")
        evaluated = monitor.snapshot().running[0]
        assert shown.share == last / 100
        assert evaluated.share == after / 100
        left = 196 if after == 100 else 110 - after  # at the end, of the 98 views that are left
        assert evaluated.left_s == pytest.approx(left, rel=0.1)
    cells.step("a", 97, 1.0)
    assert monitor.snapshot().left_s == pytest.approx(13, rel=0.1)
