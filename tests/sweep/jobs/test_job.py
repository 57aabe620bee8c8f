"""What a job does when its sweep is over."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path

import hydra
import pytest
from hydra.core.hydra_config import HydraConfig

from xrgs import config
from xrgs.capture import variant
from xrgs.cli import sweep as command
from xrgs.config import Conf
from xrgs.experiment.store import Store
from xrgs.sweep import locks
from xrgs.sweep.jobs import worker
from xrgs.sweep.jobs.job import FAIL_FAST, LOCKED, STOPPED, STORE_FULL, SweepSession, run_job


@pytest.fixture
def store(tmp_path: Path) -> Store:
    """An empty one."""
    store = Store(tmp_path / "s")
    store.prepare()
    return store


@pytest.fixture
def conf(compose: Callable[..., Conf], store: Store) -> Conf:
    """A cell's, whose variant is there as far as a job looks."""
    conf = compose("scene=motorcycle", "splat.backend=torch", f"store={store.path}")
    (store.variants / f"{variant.key(conf.scene, conf.variant)}-0").mkdir()
    return conf


@pytest.fixture
def call(tmp_path: Path) -> SweepSession:
    """A call of this process."""
    (tmp_path / "call").mkdir()
    call = SweepSession(tmp_path / "call")
    call.begin()
    return call


def signed_by(call: SweepSession, **changes: object) -> SweepSession:
    """The call as another process's."""
    file = call.folder / "sweep"
    file.write_text(json.dumps(json.loads(file.read_text()) | changes))
    return SweepSession(call.folder)


def test_a_call_is_over_when_it_is_stopped_or_its_process_is_no_more(call: SweepSession) -> None:
    assert not call.stopped
    assert signed_by(call, started=1).stopped == "the sweep is gone"
    assert not signed_by(call, host="elsewhere").stopped  # there it may run
    assert not signed_by(call, boot="another").stopped
    for reason in ("the first", "the second"):
        call.stop(reason)
        assert call.stopped == "the first"


@pytest.mark.parametrize(
    ("error", "fail_fast", "why"),
    [
        (worker.WorkerError("it raised"), True, FAIL_FAST),
        (worker.WorkerError("it raised"), False, ""),
        (worker.UnwritableError("a full disk"), True, STORE_FULL),
    ],
)
def test_a_job_that_stops_the_others_says_why(
    conf: Conf,
    call: SweepSession,
    monkeypatch: pytest.MonkeyPatch,
    error: worker.WorkerError,
    fail_fast: bool,
    why: str,
) -> None:
    def run(*_: object) -> None:
        raise error

    monkeypatch.setattr(worker, "run", run)
    conf.fail_fast = fail_fast
    run_job(conf, call)
    assert call.stopped == why


def test_a_disk_too_full_for_the_reason_stops_the_others_all_the_same(call: SweepSession) -> None:
    (call.folder / "stopped").touch()
    assert call.stopped == f"there is {call.folder / 'stopped'}"


def test_no_job_begins_for_a_sweep_that_is_gone(
    conf: Conf, call: SweepSession, store: Store
) -> None:
    assert run_job(conf, signed_by(call, started=1)) == STOPPED
    assert not list(store.cells.iterdir())


@pytest.mark.parametrize(
    ("whose", "what", "outcome"), [(locks.Owner, "lives", STOPPED), (locks.Lock, "beat", LOCKED)]
)
def test_a_cell_ends_with_its_sweep_or_its_lock_and_is_unfinished(
    conf: Conf,
    call: SweepSession,
    store: Store,
    monkeypatch: pytest.MonkeyPatch,
    whose: type,
    what: str,
    outcome: str,
) -> None:
    def run(_: str, __: object, ___: object, on_poll: Callable[[int], None]) -> None:
        on_poll(0)
        monkeypatch.setattr(whose, what, False if outcome == STOPPED else lambda *_: False)
        on_poll(0)

    monkeypatch.setattr(worker, "run", run)
    assert run_job(conf, call) == outcome
    (cell,) = store.cells.iterdir()
    assert store.cell(cell.name).state().name == "unfinished"
    assert not list(store.locks.iterdir())


class Ended(Exception):  # noqa: N818
    """In place of a process's end."""


def test_a_worker_whose_sweep_is_gone_ends_without_an_answer(
    call: SweepSession, monkeypatch: pytest.MonkeyPatch
) -> None:
    def end(_: int) -> None:
        raise Ended

    signed_by(call, started=1)
    config.register()
    with hydra.initialize_config_dir(str(config.CONF_DIR), version_base="1.3"):
        folder = f"hydra.sweep.dir={call.folder}"
        composed = hydra.compose("config", [folder], return_hydra_config=True)
    monkeypatch.setattr(HydraConfig.instance(), "cfg", composed)
    monkeypatch.setattr(os, "_exit", end)
    with pytest.raises(Ended):
        command._sweep(composed)
