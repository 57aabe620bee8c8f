"""Tests of a job: when it trains, when it leaves its cell, and what it reports."""

from __future__ import annotations

import errno
import json
import os
import shutil
import threading
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf

from tests.sweep.conftest import content
from xrgs.config import LimitsConf
from xrgs.errors import XrgsError
from xrgs.mixture import variant
from xrgs.photos import scenes
from xrgs.runtime import lease
from xrgs.store import identity
from xrgs.store.store import Store
from xrgs.sweep import job as job_module
from xrgs.sweep.job import (
    FAIL_FAST,
    GONE,
    INTERRUPTED,
    LOCKED,
    STOPPED,
    STORE_FULL,
    UNWRITABLE,
    SweepSession,
    WorkError,
    _own_gpu,
    run_hydra_job,
    run_job,
)

#: The `Cells` of tests/sweep/conftest.py.
Cells = Any


def run(session: SweepSession, cells: Cells, cell_id: str) -> str:
    return run_job(session, cells.store, cell_id, "motorcycle / a")


def ended(session: SweepSession) -> SweepSession:
    """Return the session as that of a process that has ended."""
    file = session.folder / "sweep"
    file.write_text(json.dumps(json.loads(file.read_text()) | {"started": 1}))
    return SweepSession(session.folder)


@pytest.fixture
def held(monkeypatch: pytest.MonkeyPatch) -> list[lease.Lease]:
    """The leases that jobs of this process take."""
    taken, acquire = [], lease.acquire

    def acquired(folder: Path, name: str) -> lease.Lease | None:
        if found := acquire(folder, name):
            taken.append(found)
        return found

    monkeypatch.setattr(lease, "acquire", acquired)
    return taken


@pytest.fixture
def requests(monkeypatch: pytest.MonkeyPatch, cells: Cells) -> list[tuple[str, Mapping[str, Any]]]:
    """What child processes were asked to do; none is started, and each cell is done at once."""
    requested: list[tuple[str, Mapping[str, Any]]] = []

    def finish(
        job: str, request: Mapping[str, Any], limits: LimitsConf, *_: object
    ) -> dict[str, Any]:
        assert limits == cells.store.cell(request["id"]).config().limits
        requested.append((job, request))
        cells.finish(cells.store.cell(request["id"]))
        return {"found": ["formation: LR views: 0.83 px of blur across, 0.84 down"]}

    monkeypatch.setattr(job_module, "run_in_child", finish)
    return requested


def test_a_job_trains_what_was_planned_and_reads_no_photograph(
    session: SweepSession,
    cells: Cells,
    requests: list[tuple[str, Mapping[str, Any]]],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    cell = cells.plan(seed=5, limits=LimitsConf(minutes=7.0, memory_gb=0.0))
    planned = cell.config(), cell.identity()

    def unexpected(*_: object) -> None:
        raise AssertionError("a job composes, hashes and identifies nothing")

    for module, name in (
        (scenes, "fingerprint"),
        (variant, "key"),
        (variant, "find"),
        (variant, "load"),
    ):
        monkeypatch.setattr(module, name, unexpected)
    assert run(session, cells, cell.id) == "done"
    given = {"variant": str(cells.store.variants / planned[1].variant), "cell": str(cell.path)}
    given |= {"id": cell.id, "inode": cell.path.stat().st_ino}
    assert requests == [("cell", given)]
    assert (cell.config(), cell.identity()) == planned
    assert not list(cells.store.leases.iterdir())


def test_a_cell_that_is_done_meanwhile_or_trained_elsewhere_is_left(
    session: SweepSession,
    cells: Cells,
    requests: list[tuple[str, Mapping[str, Any]]],
) -> None:
    cell_id = cells.plan().id
    assert run(session, cells, cell_id) == run(session, cells, cell_id) == "done"
    other = cells.plan(seed=1).id
    assert lease.acquire(cells.store.leases, other) is not None
    assert run(session, cells, other) == LOCKED
    assert len(requests) == 1


def test_a_job_of_other_code_or_arithmetic_trains_nothing_and_blames_no_cell(
    session: SweepSession,
    cells: Cells,
    requests: list[tuple[str, Mapping[str, Any]]],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    cell = cells.plan()
    now = identity.training_code("torch")
    # The digests that this process has computed for its plan are not trusted.
    monkeypatch.setattr(identity, "code_now", lambda *_: now | {"core": "edited"})
    with pytest.raises(XrgsError, match=r"planned with other code .*\(core\)\. Install the same"):
        run(session, cells, cell.id)
    monkeypatch.setattr(identity, "code_now", lambda *_: now)
    monkeypatch.setattr(job_module, "arithmetic", lambda _: "no-fma")
    with pytest.raises(XrgsError, match=r"planned with the arithmetic .* this machine has no-fma"):
        run(session, cells, cell.id)
    assert not requests
    assert cell.state().name == "planned"
    assert not list(cells.store.leases.iterdir())


def test_a_variant_or_a_config_that_was_removed_is_named(
    session: SweepSession, cells: Cells, tmp_path: Path
) -> None:
    cell = cells.plan()
    variant_id = cell.identity().variant
    (cells.store.variants / variant_id).rmdir()
    with pytest.raises(XrgsError, match=f"its variant .*{variant_id} is missing"):
        run(session, cells, cell.id)
    (cell.path / "config.json").unlink()
    with pytest.raises(XrgsError, match=r"config\.json: No such file"):
        run(session, cells, cell.id)
    cells.store.path.rename(tmp_path / "moved")
    assert run(session, cells, cell.id) == GONE


@pytest.mark.parametrize(
    ("error", "fail_fast", "outcome", "reason"),
    [
        (WorkError("it raised"), True, "failed", FAIL_FAST),
        (WorkError("it raised"), False, "failed", ""),
        (WorkError("a full disk", UNWRITABLE), True, UNWRITABLE, STORE_FULL),
    ],
)
def test_a_job_that_stops_the_others_says_why(
    session: SweepSession,
    cells: Cells,
    monkeypatch: pytest.MonkeyPatch,
    error: WorkError,
    fail_fast: bool,
    outcome: str,
    reason: str,
) -> None:
    def fail(*_: object) -> None:
        raise error

    monkeypatch.setattr(job_module, "run_in_child", fail)
    cell_id = cells.plan(fail_fast=fail_fast).id
    assert run(session, cells, cell_id) == outcome
    assert session.stopped == reason
    state = cells.store.cell(cell_id).state()
    assert state.name == ("failed" if outcome == "failed" else "unfinished")
    if reason:
        assert run(session, cells, cells.plan(seed=1).id) == STOPPED


@pytest.mark.usefixtures("requests")
def test_what_components_found_is_said_and_a_brief_job_that_is_done_says_nothing(
    session: SweepSession, cells: Cells, capsys: pytest.CaptureFixture[str]
) -> None:
    cell = cells.plan()
    assert run(session, cells, cell.id) == "done"
    said = capsys.readouterr().err
    assert said.count(f"{cell.id}: formation: LR views: 0.83 px of blur across, 0.84 down") == 1
    assert run(replace(session, brief=True), cells, cells.plan(seed=1).id) == "done"
    assert capsys.readouterr().err == ""


def test_a_cell_ends_with_its_sweep_and_is_unfinished(
    session: SweepSession, cells: Cells, monkeypatch: pytest.MonkeyPatch
) -> None:
    def train(on_poll: Callable[[int], None]) -> None:
        on_poll(0)
        monkeypatch.setattr(lease.Owner, "lives", False)
        on_poll(0)

    monkeypatch.setattr(job_module, "run_in_child", lambda *given: train(given[3]))
    cell = cells.plan()
    assert run(session, cells, cell.id) == STOPPED
    assert cell.state().name == "unfinished"
    assert not list(cells.store.leases.iterdir())
    later = cells.plan(seed=1)
    assert run(SweepSession(session.folder), cells, later.id) == STOPPED
    assert later.state().name == "planned"  # no further job has begun


def take_over(store: Store, cell_id: str) -> None:
    """Do what a sweep on another machine does that took this process for dead."""
    successor = store.leases / f"{cell_id}.1"
    lease.sign(successor)
    values = json.loads(successor.read_text())
    successor.write_text(json.dumps(values | {"host": "elsewhere"}))
    (store.leases / f"{cell_id}.0").unlink()
    (store.cell(cell_id).path / "log.txt").write_text("of the successor")


@pytest.mark.parametrize("end", ["before it begins", None, WorkError("no space", UNWRITABLE)])
def test_a_job_whose_lease_was_taken_over_writes_nothing_from_then_on(
    session: SweepSession,
    cells: Cells,
    held: list[lease.Lease],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    end: Exception | str | None,
) -> None:
    """Its process was stopped for long: it notices by a heartbeat, or its child has ended first."""
    cell_id = cells.plan(fail_fast=True).id
    before = {}

    def lose(*_: object) -> None:
        take_over(cells.store, cell_id)
        before["cell"], before["locks"] = (
            content(cells.store.cell(cell_id).path),
            content(cells.store.path / "locks"),
        )

    def train(on_poll: Callable[[int], None]) -> None:
        assert end != "before it begins"
        on_poll(0)
        lose()
        if isinstance(end, Exception):
            raise end
        assert not held[-1].beat()  # as its thread does
        on_poll(0)

    monkeypatch.setattr(job_module, "run_in_child", lambda *given: train(given[3]))
    if end == "before it begins":
        monkeypatch.setattr(job_module, "_check_code", lose)
    assert run(session, cells, cell_id) == LOCKED
    assert content(cells.store.cell(cell_id).path) == before["cell"]
    assert content(cells.store.path / "locks") == before["locks"]
    assert not session.stopped
    assert "another has taken over" in capsys.readouterr().err


def test_a_cell_whose_status_can_not_be_read_is_left_as_it_is(
    session: SweepSession,
    cells: Cells,
    unreadable: Callable[..., None],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    cell = cells.plan()

    def die_at_exit(*_: object) -> None:  # after the cell was finished
        cells.finish(cell)
        raise WorkError("its process was ended by SIGSEGV")

    monkeypatch.setattr(job_module, "run_in_child", die_at_exit)
    assert run(session, cells, cell.id) == "done"
    before = content(cells.store.path / "cells")
    for file, number in (("status.json", errno.EACCES), ("scores.csv", errno.ESTALE)):
        unreadable(file, number)
        assert run(session, cells, cell.id) == "failed"
        err = capsys.readouterr().err
        assert file in err
        assert os.strerror(number) in err
        unreadable("", 0)
    assert content(cells.store.path / "cells") == before
    assert not session.stopped
    other = cells.plan(seed=1)

    def die_on_a_sick_disk(*_: object) -> None:
        (other.path / "status.json").write_text('{"state": "done"}')
        unreadable("status.json", errno.EIO)
        raise WorkError("it raised")

    monkeypatch.setattr(job_module, "run_in_child", die_on_a_sick_disk)
    assert run(session, cells, other.id) == "failed"
    assert not (other.path / "error.txt").exists()  # the child may have finished the cell


@pytest.mark.parametrize(("executor", "ends"), [("local", False), ("slurm", True)])
def test_a_cell_that_is_asked_to_end_is_unfinished_and_slurm_decides_on_its_job(
    session: SweepSession,
    job_config: DictConfig,
    cells: Cells,
    monkeypatch: pytest.MonkeyPatch,
    executor: str,
    ends: bool,
) -> None:
    def train(*_: object) -> None:
        raise WorkError("its process was ended by SIGTERM", INTERRUPTED)

    monkeypatch.setattr(job_module, "run_in_child", train)
    monkeypatch.setenv("SUBMITIT_EXECUTOR", executor)
    job_config.cell = cells.plan(fail_fast=True).id
    if ends:
        with pytest.raises(SystemExit, match=str(os.EX_TEMPFAIL)):
            run_hydra_job(job_config)
    else:
        assert run_hydra_job(job_config) == INTERRUPTED
    assert cells.store.cell(job_config.cell).state().name == "unfinished"
    assert not list(cells.store.leases.iterdir())
    assert not session.stopped


@pytest.mark.parametrize(
    ("how", "seen"), [("deleted", "by its parent"), ("unmounted", "by the child")]
)
def test_a_store_that_vanishes_while_a_cell_trains_does_not_reappear(
    session: SweepSession,
    cells: Cells,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    how: str,
    seen: str,
) -> None:
    def train(on_poll: Callable[[int], None]) -> None:
        on_poll(0)
        cells.store.path.rename(tmp_path / "moved")
        if how == "deleted":
            shutil.rmtree(tmp_path / "moved")
        elif how == "unmounted":
            cells.store.path.mkdir()
        if seen == "by the child":
            raise WorkError("FileNotFoundError: no such file")
        on_poll(0)

    monkeypatch.setattr(job_module, "run_in_child", lambda *given: train(given[3]))
    assert run(session, cells, cells.plan(fail_fast=True).id) == GONE
    assert "moved" not in capsys.readouterr().err  # the sweep says it once
    if how == "unmounted":
        cells.store.path.rmdir()  # empty
    assert not cells.store.path.exists()
    assert not session.stopped


class ProcessEnded(Exception):  # noqa: N818
    """Stands in for the end of the process."""


@pytest.fixture
def job_config(
    session: SweepSession, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> DictConfig:
    """The config that a launcher gives to a job."""
    hydra = OmegaConf.create({"hydra": {"sweep": {"dir": str(session.folder)}}})
    monkeypatch.setattr(HydraConfig.instance(), "cfg", hydra)
    return OmegaConf.create({"cell": "x", "store": str(tmp_path / "s"), "name": "a"})


def test_a_launcher_s_worker_answers_unless_its_sweep_has_ended(
    session: SweepSession,
    job_config: DictConfig,
    cells: Cells,
    requests: list[tuple[str, Mapping[str, Any]]],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    job_config.cell = cells.plan().id
    assert run_hydra_job(job_config) == "done"
    assert len(requests) == 1

    def end(_: int) -> None:
        raise ProcessEnded

    ended(session)
    monkeypatch.setattr(os, "_exit", end)
    with pytest.raises(ProcessEnded):
        run_hydra_job(job_config)


@pytest.mark.slow
def test_jobs_of_one_machine_have_a_gpu_each(
    session: SweepSession, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "GPU-a,GPU-b")
    third: list[Mapping[str, str]] = []

    def run_third() -> None:
        with _own_gpu(session, "gsplat") as environment:
            third.append(environment)

    waiting = threading.Thread(target=run_third)
    with _own_gpu(session, "gsplat") as first:
        assert first == {"CUDA_VISIBLE_DEVICES": "GPU-a"}
        with _own_gpu(session, "gsplat") as second:
            assert second == {"CUDA_VISIBLE_DEVICES": "GPU-b"}
            waiting.start()
            waiting.join(0.5)
            assert not third
        waiting.join()
        assert third == [second]
    assert not list((session.folder / "gpus").iterdir())
    session.end()
    assert not session.folder.exists()
    with _own_gpu(session, "native") as environment:
        assert environment == {}
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "3")  # it is no choice
    with _own_gpu(session, "gsplat") as environment:
        assert environment == {}
