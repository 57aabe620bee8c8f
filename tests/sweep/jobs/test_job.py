"""Tests of a job: when it trains, when it leaves its cell, and what it reports."""

from __future__ import annotations

import errno
import json
import os
import shutil
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pytest
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf

from xrgs.capture import scenes, variant
from xrgs.cli import sweep as command
from xrgs.errors import XrgsError
from xrgs.experiment.attempts import begin_attempt
from xrgs.experiment.store import Store
from xrgs.sweep import locks
from xrgs.sweep.jobs import worker
from xrgs.sweep.jobs.job import (
    FAIL_FAST,
    GONE,
    INTERRUPTED,
    LOCKED,
    STOPPED,
    STORE_FULL,
    UNKNOWN,
    UNWRITABLE,
    run_job,
)
from xrgs.sweep.session import HandOver, SweepSession

HandOverOf = Callable[..., HandOver]


def ended(session: SweepSession) -> SweepSession:
    """Return the session as that of a process that has ended."""
    file = session.folder.path / "sweep"
    file.write_text(json.dumps(json.loads(file.read_text()) | {"started": 1}))
    return SweepSession(session.folder.path)


@pytest.fixture
def requests(monkeypatch: pytest.MonkeyPatch, store: Store) -> list[tuple[str, Mapping[str, Any]]]:
    """What child processes were asked to do; none is started, and each cell is done at once."""
    requested: list[tuple[str, Mapping[str, Any]]] = []

    def finish(job: str, request: Mapping[str, Any], *_: object) -> dict[str, Any]:
        requested.append((job, request))
        folder = store.cell(Path(request["cell"]).name)
        (folder.path / "scores.csv").write_text("view\na\n")
        folder.finish(["a"], 1)
        return {}

    monkeypatch.setattr(worker, "run_in_child", finish)
    return requested


def test_a_job_trains_what_was_planned_and_reads_no_photograph(
    session: SweepSession,
    store: Store,
    hand_over_of: HandOverOf,
    requests: list[tuple[str, Mapping[str, Any]]],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    made = hand_over_of(seed=5)
    cell_id = session.hand_over(made)

    def unexpected(*_: object) -> None:
        raise AssertionError("a job composes, hashes and identifies nothing")

    for module, name in (
        (scenes, "fingerprint"),
        (variant, "key"),
        (variant, "find"),
        (variant, "load"),
    ):
        monkeypatch.setattr(module, name, unexpected)
    assert run_job(session, cell_id) == "done"
    folder = store.cell(cell_id)
    assert requests == [
        (
            "cell",
            {
                "conf": made.config,
                "variant": str(store.variants / made.variant_id),
                "cell": str(folder.path),
                "folder": folder.folder.identity(),
            },
        )
    ]
    assert folder.identity() == made.identity
    assert json.loads((folder.path / "config.json").read_text()) == made.config
    assert not list(store.locks.iterdir())


def test_a_cell_that_is_done_meanwhile_is_not_trained_again(
    session: SweepSession,
    hand_over_of: HandOverOf,
    requests: list[tuple[str, Mapping[str, Any]]],
) -> None:
    cell_id = session.hand_over(hand_over_of())
    assert run_job(session, cell_id) == run_job(session, cell_id) == "done"
    assert len(requests) == 1


def test_a_cell_that_another_process_trains_is_left_to_it(
    session: SweepSession,
    store: Store,
    hand_over_of: HandOverOf,
    requests: list[tuple[str, Mapping[str, Any]]],
) -> None:
    cell_id = session.hand_over(hand_over_of())
    assert locks.acquire(store.locks, cell_id) is not None
    assert run_job(session, cell_id) == LOCKED
    assert not requests


def test_a_job_of_other_code_trains_nothing_and_blames_no_cell(
    session: SweepSession,
    store: Store,
    hand_over_of: HandOverOf,
    requests: list[tuple[str, Mapping[str, Any]]],
) -> None:
    made = hand_over_of()
    planned = dict(made.identity) | {"code": {"splat/densify.py": "0"}}
    cell_id = session.hand_over(HandOver(made.name, made.config, planned))
    with pytest.raises(XrgsError, match="planned with other code"):
        run_job(session, cell_id)
    assert not requests
    assert store.cell(cell_id).state().name == "absent"
    assert not list(store.locks.iterdir())


def test_a_variant_that_was_removed_is_named(
    session: SweepSession, store: Store, hand_over_of: HandOverOf
) -> None:
    made = hand_over_of()
    (store.variants / made.variant_id).remove()
    with pytest.raises(XrgsError, match=f"its variant .*{made.variant_id} is missing"):
        run_job(session, session.hand_over(made))


@pytest.mark.parametrize(
    ("error", "fail_fast", "outcome", "reason"),
    [
        (worker.WorkerError("it raised"), True, "failed", FAIL_FAST),
        (worker.WorkerError("it raised"), False, "failed", ""),
        (worker.UnwritableError("a full disk"), True, UNWRITABLE, STORE_FULL),
    ],
)
def test_a_job_that_stops_the_others_says_why(
    session: SweepSession,
    store: Store,
    hand_over_of: HandOverOf,
    monkeypatch: pytest.MonkeyPatch,
    error: worker.WorkerError,
    fail_fast: bool,
    outcome: str,
    reason: str,
) -> None:
    def fail(*_: object) -> None:
        raise error

    monkeypatch.setattr(worker, "run_in_child", fail)
    cell_id = session.hand_over(hand_over_of(fail_fast=fail_fast))
    assert run_job(session, cell_id) == outcome
    assert session.stopped == reason
    state = store.cell(cell_id).state()
    assert state.name == ("failed" if outcome == "failed" else "unfinished")
    if reason:
        assert run_job(session, session.hand_over(hand_over_of(seed=1))) == STOPPED


def test_a_cell_whose_process_died_after_it_was_finished_is_done(
    session: SweepSession,
    store: Store,
    hand_over_of: HandOverOf,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def die_at_exit(_: str, request: Mapping[str, Any], *__: object) -> None:
        folder = store.cell(Path(request["cell"]).name)
        (folder.path / "scores.csv").write_text("view\na\n")
        folder.finish(["a"], 1)
        raise worker.WorkerError("its process was ended by SIGSEGV")

    monkeypatch.setattr(worker, "run_in_child", die_at_exit)
    assert run_job(session, session.hand_over(hand_over_of())) == "done"


def test_no_job_begins_for_a_sweep_whose_process_has_ended(
    session: SweepSession, store: Store, hand_over_of: HandOverOf
) -> None:
    cell_id = session.hand_over(hand_over_of())
    assert run_job(ended(session), cell_id) == STOPPED
    assert not list(store.cells_folder.iterdir())


@pytest.mark.parametrize(
    ("owner", "attribute", "outcome"),
    [(locks.Owner, "lives", STOPPED), (locks.Lock, "beat", LOCKED)],
)
def test_a_cell_ends_with_its_sweep_or_its_lock_and_is_unfinished(
    session: SweepSession,
    store: Store,
    hand_over_of: HandOverOf,
    monkeypatch: pytest.MonkeyPatch,
    owner: type,
    attribute: str,
    outcome: str,
) -> None:
    def train(_: str, __: object, ___: object, on_poll: Callable[[int], None]) -> None:
        on_poll(0)
        lost = False if outcome == STOPPED else lambda *_: False
        monkeypatch.setattr(owner, attribute, lost)
        on_poll(0)

    monkeypatch.setattr(worker, "run_in_child", train)
    assert run_job(session, session.hand_over(hand_over_of())) == outcome
    (cell,) = store.cells_folder.iterdir()
    assert store.cell(cell.name).state().name == "unfinished"
    assert not list(store.locks.iterdir())


def test_a_cell_that_was_taken_over_is_left_as_it_is(
    session: SweepSession,
    store: Store,
    hand_over_of: HandOverOf,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    made = hand_over_of()

    def lose(_: str, request: Mapping[str, Any], *__: object) -> None:
        folder = begin_attempt(store.cell(Path(request["cell"]).name), made.config, made.identity)
        (folder.path / "scores.csv").write_text("view\na\n")
        folder.finish(["a"], 1)
        raise worker.AttemptLostError("another attempt at the cell has begun")

    monkeypatch.setattr(worker, "run_in_child", lose)
    cell_id = session.hand_over(made)
    assert run_job(session, cell_id) == LOCKED
    assert store.cell(cell_id).state().name == "done"


def content(folder: Path) -> dict[str, tuple[int, int, bytes]]:
    """Inode, time and bytes of every file of a folder."""
    files = [file for file in folder.rglob("*") if file.is_file()]
    stats = {file: file.stat() for file in files}
    return {f.name: (s.st_ino, s.st_mtime_ns, f.read_bytes()) for f, s in stats.items()}


def take_over(store: Store, cell_id: str) -> None:
    """Do what a sweep on another machine does that took this process for dead."""
    successor = store.locks / f"{cell_id}.1"
    locks.sign(successor)
    values = json.loads(successor.read_text())
    successor.path.write_text(json.dumps(values | {"host": "elsewhere"}))
    (store.locks / f"{cell_id}.0").unlink()
    (store.cell(cell_id).path / "log.txt").write_text("of the successor")


@pytest.mark.parametrize(
    "end",
    [
        None,
        worker.WorkerError("its process was ended by SIGKILL"),
        worker.UnwritableError("no space"),
        worker.PassingError("stale"),
    ],
)
def test_a_job_whose_lock_was_taken_over_writes_nothing_from_then_on(
    session: SweepSession,
    store: Store,
    hand_over_of: HandOverOf,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    end: Exception | None,
) -> None:
    """Its process was stopped for long: it notices by a heartbeat, or its child has ended first."""
    cell_id = session.hand_over(hand_over_of(fail_fast=True))
    before = {}

    def train(_: str, __: object, ___: object, on_poll: Callable[[int], None]) -> None:
        on_poll(0)
        take_over(store, cell_id)
        before["cell"], before["locks"] = (
            content(store.cell(cell_id).path),
            content(store.path / "locks"),
        )
        if end is not None:
            raise end
        monkeypatch.setattr(locks, "BEAT_S", 0.0)
        on_poll(0)

    monkeypatch.setattr(worker, "run_in_child", train)
    assert run_job(session, cell_id) == LOCKED
    assert content(store.cell(cell_id).path) == before["cell"]
    assert content(store.path / "locks") == before["locks"]
    assert not session.stopped
    assert "another has taken over" in capsys.readouterr().err


def test_a_lock_that_is_lost_before_the_training_begins_is_noticed(
    session: SweepSession,
    store: Store,
    hand_over_of: HandOverOf,
    requests: list[tuple[str, Mapping[str, Any]]],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    cell_id = session.hand_over(hand_over_of())

    def check(_: HandOver) -> None:
        store.cell(cell_id).folder.make_folder()
        take_over(store, cell_id)

    monkeypatch.setattr(HandOver, "check_code", check)
    assert run_job(session, cell_id) == LOCKED
    assert content(store.cell(cell_id).path).keys() == {"log.txt"}
    assert not requests


@pytest.mark.parametrize("number", [errno.EACCES, errno.EIO, errno.ESTALE])
def test_a_cell_whose_status_can_not_be_read_is_left_as_it_is(
    session: SweepSession,
    store: Store,
    hand_over_of: HandOverOf,
    requests: list[tuple[str, Mapping[str, Any]]],
    sick: Callable[[str, int], None],
    capsys: pytest.CaptureFixture[str],
    number: int,
) -> None:
    cell_id = session.hand_over(hand_over_of())
    assert run_job(session, cell_id) == "done"
    before = content(store.path / "cells")
    for file in ("status.json", "scores.csv"):
        sick(file, number)
        assert run_job(session, cell_id) == UNKNOWN
        err = capsys.readouterr().err
        assert file in err
        assert os.strerror(number) in err
    sick("", 0)
    assert content(store.path / "cells") == before
    assert len(requests) == 1
    assert not session.stopped
    assert run_job(session, cell_id) == "done"


@pytest.mark.parametrize("number", [errno.EACCES, errno.EIO, errno.ESTALE])
@pytest.mark.parametrize("end", ["stale", "raised"])
def test_a_file_that_can_not_be_read_fails_no_cell(
    session: SweepSession,
    store: Store,
    hand_over_of: HandOverOf,
    sick: Callable[[str, int], None],
    monkeypatch: pytest.MonkeyPatch,
    number: int,
    end: str,
) -> None:
    """In the child, or in its parent when the child has failed."""
    cell_id = session.hand_over(hand_over_of(fail_fast=True))

    def train(*_: object) -> None:
        if end == "stale":
            raise worker.PassingError("stale")
        (store.cell(cell_id).path / "status.json").write_text('{"state": "done"}')
        sick("status.json", number)
        raise worker.WorkerError("it raised")

    monkeypatch.setattr(worker, "run_in_child", train)
    assert run_job(session, cell_id) == UNKNOWN
    assert not (store.cell(cell_id).path / "error.txt").exists()
    assert not session.stopped


@pytest.mark.parametrize(("executor", "ends"), [("local", False), ("slurm", True)])
def test_a_cell_that_is_asked_to_end_is_unfinished_and_slurm_decides_on_its_job(
    session: SweepSession,
    job_config: DictConfig,
    store: Store,
    hand_over_of: HandOverOf,
    monkeypatch: pytest.MonkeyPatch,
    executor: str,
    ends: bool,
) -> None:
    def train(*_: object) -> None:
        raise worker.InterruptedWorkError("its process was ended by SIGTERM")

    monkeypatch.setattr(worker, "run_in_child", train)
    monkeypatch.setenv("SUBMITIT_EXECUTOR", executor)
    job_config.cell = session.hand_over(hand_over_of(fail_fast=True))
    if ends:
        with pytest.raises(SystemExit, match=str(os.EX_TEMPFAIL)):
            command._run_job(job_config)
    else:
        assert command._run_job(job_config) == INTERRUPTED
    assert store.cell(job_config.cell).state().name == "unfinished"
    assert not list(store.locks.iterdir())
    assert not session.stopped


@pytest.mark.parametrize("how", ["renamed", "deleted", "unmounted"])
@pytest.mark.parametrize("seen", ["by its parent", "by the child"])
def test_a_store_that_vanishes_while_a_cell_trains_does_not_reappear(
    session: SweepSession,
    store: Store,
    hand_over_of: HandOverOf,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    how: str,
    seen: str,
) -> None:
    def train(_: str, __: object, ___: object, on_poll: Callable[[int], None]) -> None:
        on_poll(0)
        store.path.rename(tmp_path / "moved")
        if how == "deleted":
            shutil.rmtree(tmp_path / "moved")
        elif how == "unmounted":
            store.path.mkdir()
        if seen == "by the child":
            raise worker.WorkerError("FileNotFoundError: no such file")
        on_poll(0)

    monkeypatch.setattr(worker, "run_in_child", train)
    assert run_job(session, session.hand_over(hand_over_of(fail_fast=True))) == GONE
    assert "moved" not in capsys.readouterr().err  # the sweep says it once
    if how == "unmounted":
        store.path.rmdir()  # empty
    assert not store.path.exists()
    assert not session.stopped


class ProcessEnded(Exception):  # noqa: N818
    """Stands in for the end of the process."""


@pytest.fixture
def job_config(session: SweepSession, monkeypatch: pytest.MonkeyPatch) -> DictConfig:
    """The config that a launcher gives to a job."""
    hydra = OmegaConf.create({"hydra": {"sweep": {"dir": str(session.folder)}}})
    monkeypatch.setattr(HydraConfig.instance(), "cfg", hydra)
    return OmegaConf.create({"cell": "x"})


def test_a_launcher_s_worker_whose_sweep_has_ended_ends_without_an_answer(
    session: SweepSession, job_config: DictConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    def end(_: int) -> None:
        raise ProcessEnded

    ended(session)
    monkeypatch.setattr(os, "_exit", end)
    with pytest.raises(ProcessEnded):
        command._run_job(job_config)


def test_the_command_hands_a_cell_s_id_to_its_job(
    session: SweepSession,
    job_config: DictConfig,
    hand_over_of: HandOverOf,
    requests: list[tuple[str, Mapping[str, Any]]],
) -> None:
    job_config.cell = session.hand_over(hand_over_of())
    assert command._run_job(job_config) == "done"
    assert len(requests) == 1
