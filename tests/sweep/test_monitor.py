"""Tests that a running sweep is read from the files that its cells write, with any launcher."""

from __future__ import annotations

import errno
import io
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import msgspec
import pytest

from xrgs.config import Conf
from xrgs.runtime.progress import Progress
from xrgs.safeio.atomic import write_json
from xrgs.store.cell_folder import CellState
from xrgs.sweep import monitor as monitor_module
from xrgs.sweep.axes import CellSpec
from xrgs.sweep.estimate import Cost
from xrgs.sweep.monitor import SweepMonitor
from xrgs.sweep.plan import PlannedCell


class Watched:
    """Planned cells, and the files of those that are begun."""

    def __init__(self, cells: Any, conf: Conf) -> None:
        self.cells, self.store, self.conf = cells, cells.store, conf

    def plan(
        self, name: str, state: str = "absent", seconds: float | None = None, scoring: float = 0.0
    ) -> PlannedCell:
        cost = None if seconds is None else Cost(seconds, scoring, 1e9, 1e6)
        spec, now = CellSpec(name, "", (), ()), CellState(state)
        return PlannedCell(spec, self.conf, "v", None, name, now, cost=cost)

    def begin(self, name: str) -> None:
        self.cells.begin(name)

    def step(self, name: str, done: int, rate: float | None, what: str = "training") -> None:
        unit = "step" if what == "training" else "view"
        now = Progress(what, unit, done, 100, rate)
        write_json(self.store.cell(name).progress, msgspec.structs.asdict(now))

    def finish(self, name: str) -> None:
        self.store.cell(name).progress.unlink(missing_ok=True)
        self.cells.finish(self.store.cell(name))


@pytest.fixture
def watched(cells: Any, compose: Callable[..., Conf]) -> Watched:
    """Cells of 100 steps."""
    return Watched(cells, compose("train.steps=100"))


def test_states_are_read_from_the_cells_files_alone(watched: Watched) -> None:
    watched.begin("failed")
    watched.store.cell("failed").fail("it raised")
    monitor = SweepMonitor(watched.store.cells_folder)
    names = ("a", "b", "c")
    plan = [watched.plan(name) for name in names] + [
        watched.plan("failed", "failed"),
        watched.plan("done", "done"),
        replace(watched.plan("none"), cell_id=None, error="no variant"),
    ]
    monitor.watch(plan)
    assert str(monitor.snapshot()) == "1 of 6 cells done, 2 failed"
    watched.begin("a")
    watched.step("a", 20, 10.0)
    snapshot = monitor.snapshot()
    assert [cell.cell.cell_id for cell in snapshot.running] == ["a"]
    # 80 steps of a, and 100 of b and of c, which nothing else is known of
    assert str(snapshot) == (
        "1 of 6 cells done, 2 failed, 10 steps/s, ~28 s left,"
        " procedural / a / seed 0: training 20 of 100 steps"
    )
    watched.begin("b")
    watched.step("b", 50, 5.0)
    # 8 s and 10 s, and c at their mean pace 15 s: by two at once
    assert str(monitor.snapshot()).endswith("2 failed, 2 in training, 15 steps/s, ~16 s left")
    watched.finish("a")
    watched.store.cell("b").fail("it raised")
    watched.begin("c")
    assert str(monitor.snapshot()).startswith("2 of 6 cells done, 3 failed, ~15 s left")


def test_a_single_training_is_shown_without_the_words_of_a_study(
    watched: Watched, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(monitor_module, "_LINE_S", -1.0)
    with SweepMonitor(watched.store.cells_folder, brief=True) as monitor:
        monitor._stop.set()  # this test looks by itself
        monitor.watch([watched.plan("a")])
        watched.begin("a")
        watched.step("a", 20, 10.0)
        monitor._show(monitor.snapshot())
        watched.finish("a")
    assert capsys.readouterr().err == "training 20 of 100 steps, 10 steps/s, ~8 s left\n"


def test_progress_never_goes_back(watched: Watched, monkeypatch: pytest.MonkeyPatch) -> None:
    """A cell has no progress file for a moment between its evaluation and its end."""
    monitor = SweepMonitor(watched.store.cells_folder)
    monitor.watch([watched.plan("a", seconds=1000.0, scoring=10.0), watched.plan("b")])
    watched.begin("a")
    seen = []
    monkeypatch.setattr(monitor_module, "is_terminal", lambda _: True)
    monkeypatch.setattr("sys.stderr", io.StringIO())
    for done, what in ((50, "training"), (100, "training"), (3, "evaluating"), (0, "training")):
        watched.step("a", done, 10.0, what)
        monitor._show(monitor.snapshot())
        seen.append(monitor._bar.n)  # type: ignore[union-attr]
    assert seen == [0.5, 1.0, 1.0, 1.0]
    watched.step("a", 100, 10.0)
    monitor.snapshot()
    watched.store.cell("a").progress.unlink()
    snapshot = monitor.snapshot()
    assert snapshot.progress == 1.0
    (waiting, _) = snapshot.waiting
    assert snapshot.expected_s(waiting, snapshot.trained(waiting)) == pytest.approx(10.0)
    watched.finish("a")
    assert monitor.snapshot().progress == 1.0
    monitor._bar.close()  # type: ignore[union-attr]


def test_another_sweeps_cell_is_waited_for(watched: Watched) -> None:
    monitor = SweepMonitor(watched.store.cells_folder)
    monitor.watch([watched.plan("a"), watched.plan("b", "running")])
    watched.begin("b")
    watched.step("b", 90, 0.1)
    assert str(monitor.snapshot()) == "0 of 2 cells done, 1 in another sweep"
    watched.begin("a")
    watched.step("a", 0, 10.0)
    assert "~2 min left, " in str(monitor.snapshot())  # b's ten steps, not a's ten seconds
    watched.finish("b")
    assert monitor.snapshot().done == 1


def test_a_cell_that_is_trained_again_has_not_ended_before_it_does(watched: Watched) -> None:
    watched.begin("failed")
    watched.store.cell("failed").fail("once")
    conf = replace(watched.conf, retry="failed")
    plan = [replace(watched.plan("failed", "failed"), conf=conf)]
    monitor = SweepMonitor(watched.store.cells_folder)
    monitor.watch(plan)
    assert str(monitor.snapshot()) == "0 of 1 cells done"
    watched.begin("failed")
    watched.store.cell("failed").fail("twice")
    assert str(monitor.snapshot()) == "0 of 1 cells done, 1 failed"
    monitor.watch(plan)
    assert str(monitor.snapshot()) == "0 of 1 cells done, 1 failed"


def test_files_that_a_killed_process_left_are_no_sign_of_life(
    watched: Watched, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("before", "now"):
        watched.begin(name)
    watched.step("before", 5, 1.0)
    monitor = SweepMonitor(watched.store.cells_folder)
    monitor.watch([watched.plan("before", "unfinished"), watched.plan("now")])
    assert not monitor.snapshot().running
    watched.step("now", 5, 1.0)
    assert len(monitor.snapshot().running) == 1
    monkeypatch.setattr(monitor_module, "_SILENT_S", 0.0)
    assert not monitor.snapshot().running


def test_past_cells_decide_at_first_and_the_own_pace_in_the_end(watched: Watched) -> None:
    monitor = SweepMonitor(watched.store.cells_folder)
    monitor.watch([watched.plan("a", seconds=100.0)])
    watched.begin("a")
    for what, done, rate, seconds in (
        ("loading", 0, None, 100),
        ("training", 0, None, 100),
        ("training", 0, 50.0, 100),
        ("training", 20, 10.0, 0.8 * 80 + 0.2 * 8),
        ("training", 99, 10.0, 0.01 * 1 + 0.99 * 0.1),
        ("evaluating", 10, 9.0, 1),
    ):
        watched.step("a", done, rate, what)
        snapshot = monitor.snapshot()
        (running,) = snapshot.running
        assert replace(snapshot, slowness=1.0).rest_s(running) == pytest.approx(seconds)


@pytest.mark.slow
def test_a_log_has_a_line_when_a_cell_ends_and_the_last_at_the_end(
    watched: Watched, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(monitor_module, "_POLL_S", 0.01)
    with SweepMonitor(watched.store.cells_folder) as monitor:
        monitor.watch([watched.plan("a"), watched.plan("b"), watched.plan("old", "done")])
        for name in ("a", "b"):
            watched.begin(name)
            watched.step(name, 1, 1.0)
            time.sleep(0.1)
            watched.finish(name)
            if name == "a":
                time.sleep(0.5)
    output = capsys.readouterr().err
    with SweepMonitor(watched.store.cells_folder) as monitor:
        monitor.watch([watched.plan("a", "done"), watched.plan("b", "failed")])
    assert capsys.readouterr().err == ""  # nothing was left to do
    assert "\r" not in output
    assert [line[:18] for line in output.splitlines()] == [
        "2 of 3 cells done,",
        "3 of 3 cells done",
    ]


def test_a_terminal_shows_one_line_which_is_removed_at_the_end(
    watched: Watched, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Terminal(io.StringIO):
        def isatty(self) -> bool:
            return True

    terminal = Terminal()
    monkeypatch.setattr("sys.stderr", terminal)
    monkeypatch.setattr(monitor_module, "_POLL_S", 0.01)
    with SweepMonitor(watched.store.cells_folder) as monitor:
        monitor.watch([watched.plan("a"), watched.plan("b")])
        watched.begin("a")
        watched.step("a", 50, 1.0)
        end = time.monotonic() + 60  # on a busy machine the monitor's thread may wait for its turn
        while " 25%|" not in terminal.getvalue():
            assert time.monotonic() < end
            time.sleep(0.01)
        watched.finish("a")
    output = terminal.getvalue()
    assert "0 of 2 cells done, 1 steps/s, ~2 min left, procedural / a" in output
    *_, last = output.split("\r")
    assert last.startswith("\x1b[K1 of 2 cells done")
    assert output.count("\n") == 1


def test_what_can_not_be_read_now_is_read_again(
    watched: Watched, unreadable: Callable[..., None]
) -> None:
    monitor = SweepMonitor(watched.store.cells_folder)
    monitor.watch([watched.plan("a"), watched.plan("b")])
    gone = watched.store.path.with_name("gone")
    watched.store.path.rename(gone)
    assert str(monitor.snapshot()) == "0 of 2 cells done"
    gone.rename(watched.store.path)
    watched.begin("a")
    watched.finish("a")
    unreadable("status.json", errno.EIO)
    assert str(monitor.snapshot()) == "0 of 2 cells done"
    unreadable("", 0)
    assert str(monitor.snapshot()) == "1 of 2 cells done"
    watched.store.path.rename(gone)
    assert str(monitor.snapshot()) == "1 of 2 cells done"  # it was seen to end


def test_what_this_sweep_s_cells_took_tells_of_those_that_wait(
    watched: Watched, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two at once that take three times as long as past cells did, and two more of them."""
    now = 1000.0
    monkeypatch.setattr(time, "monotonic", lambda: now)
    monitor = SweepMonitor(watched.store.cells_folder)
    monitor.watch([watched.plan(name, seconds=100.0) for name in ("a", "b", "c", "d")])
    for name in ("a", "b"):
        watched.begin(name)
        watched.step(name, 0, None)
    assert monitor.snapshot().left_s == pytest.approx(200)
    now += 150
    for name in ("a", "b"):
        watched.step(name, 50, 1 / 3)
    # Each of the four takes 300 s in all, and 150 s are over for two.
    assert monitor.snapshot().left_s == pytest.approx(450)
    now += 150
    for name in ("a", "b"):
        watched.finish(name)
    assert monitor.snapshot().left_s == pytest.approx(300)  # two at once, as before


def test_the_first_cells_of_a_store_are_followed_by_their_pace(watched: Watched) -> None:
    monitor = SweepMonitor(watched.store.cells_folder)
    monitor.watch([watched.plan("a"), watched.plan("b")])
    watched.begin("a")
    watched.step("a", 1, None, "loading")
    assert monitor.snapshot().left_s is None
    watched.step("a", 50, 10.0)
    assert monitor.snapshot().left_s == pytest.approx(5 + 10)
    watched.step("a", 2, 1.0, "evaluating")
    assert monitor.snapshot().left_s == pytest.approx(5 + 10)
