"""Runs one planned cell in a process of its own, on whatever machine the launcher has chosen.

A cell that fails is a state and not an exception, so that no launcher drops the rest of its batch.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from xrgs.errors import UnreadableError, XrgsError
from xrgs.experiment.attempts import begin_attempt
from xrgs.experiment.store import Store
from xrgs.runtime.progress import log_line
from xrgs.safeio.confined import is_passing
from xrgs.sweep import locks, presence, variants
from xrgs.sweep.jobs import worker
from xrgs.sweep.jobs.supervise import Limits

if TYPE_CHECKING:
    from xrgs.experiment.cell_folder import CellFolder
    from xrgs.safeio.confined import ConfinedPath
    from xrgs.sweep.session import HandOver, SweepSession

#: Outcomes of a job beside the states of a cell. LOCKED: another sweep is training the cell.
#: STOPPED: the sweep is over, or no further job may begin. UNWRITABLE: the store can't be written.
#: GONE: the store is no longer there. UNKNOWN: a file can't be read now, and the cell was left.
#: INTERRUPTED: a signal asked the cell's process to end, and the next sweep continues the cell.
LOCKED, STOPPED, UNWRITABLE, GONE, UNKNOWN = "locked", "stopped", "unwritable", "gone", "unknown"
INTERRUPTED = "interrupted"
#: Reasons for which no further job of a sweep begins, see `SweepSession.stop`.
FAIL_FAST, STORE_FULL = "fail_fast, and a cell failed", "the store can't be written"
#: Outcomes of errors that are no fault of the cell: the next sweep trains it without `retry`.
_NO_FAULT = {
    worker.InterruptedWorkError: INTERRUPTED,
    worker.UnwritableError: UNWRITABLE,
    UnreadableError: UNKNOWN,
}


class _CellLeftError(XrgsError):
    """This job has to leave its cell unfinished, which is no fault of the cell."""

    def __init__(self, outcome: str) -> None:
        super().__init__(outcome)
        self.outcome = outcome
        """The outcome of the job."""


def run_job(session: SweepSession, cell_id: str) -> str:
    """Run one cell of a sweep, unless there is a reason not to.

    Args:
        session: The call of `xrgs-sweep` that the job belongs to.
        cell_id: The cell's id; the session's folder holds its config and identity.

    Returns:
        The cell's state, or `LOCKED`, `STOPPED`, `UNWRITABLE`, `GONE`, `UNKNOWN` or `INTERRUPTED`.

    Raises:
        XrgsError: The cell was not handed over by this sweep's plan, its code is not the planned
            one, or its variant is missing, or trimmed and its images can't be made again.
    """
    if session.stopped:
        return STOPPED
    if session.missing:
        log_line(
            f"{session.folder} is not there, so that {cell_id} is left: hydra.sweep.dir must be a"
            " folder that every machine of the sweep can read"
        )
        return GONE
    cell = session.read(cell_id)
    store = Store(Path(cell.config["store"]))
    try:
        outcome = _run_under_lock(cell, store, session)
    except OSError as error:
        outcome = _outcome_of(error, store)
        if outcome != GONE:
            log_line(f"store={store.path}: {error}")
    if outcome == UNWRITABLE:
        session.stop(STORE_FULL)
    if cell.config["fail_fast"] and outcome == "failed":
        session.stop(FAIL_FAST)
    return outcome


def _outcome_of(error: OSError, store: Store) -> str:
    """Return the outcome of a job that an error of the store ended; raise any other error again."""
    if presence.is_gone(store):
        return GONE
    if worker.unwritable(error):
        return UNWRITABLE
    if not is_passing(error):
        raise error
    return UNKNOWN


def _run_under_lock(cell: HandOver, store: Store, session: SweepSession) -> str:
    """Train the cell unless another process is training it, or has finished it meanwhile."""
    # The plan has verified the variant's files, and the child process verifies them again. Of a
    # trimmed variant the plan knows the id alone.
    variant = store.variants / cell.variant_id
    if not variant.is_dir():
        variants.restore(cell.config, store, cell.variant_id)
    if not variant.is_dir():
        raise XrgsError(f"{cell.name}: its variant {variant} is missing")
    folder = store.cell(cell.cell_id)
    lock = locks.acquire(store.locks, folder.id, cell.dead_locks)
    if lock is None:
        log_line(f"{folder.id}: another sweep is training this cell; this sweep leaves it")
        return LOCKED
    try:
        state = folder.state()
        if state.name == "unknown":
            log_line(f"{folder.id} is left: {state.reason}")
        if state.name in {"done", "unknown"}:  # done by another sweep since this one was planned
            return state.name
        cell.check_code()
        if not lock.is_held():
            return _lost(folder)
        attempt = begin_attempt(folder, cell.config, cell.identity)
        log_line(f"{cell.name}: training cell {folder.id}")
        return _train_in_child(cell, store, variant, attempt, lock, session)
    finally:
        lock.release()


def _lost(folder: CellFolder) -> str:
    """Say that the lock is lost; from then on this job does not touch the cell's folder."""
    log_line(
        f"{folder.id} is left: this process gave no sign of life for too long, and another has"
        " taken over"
    )
    return LOCKED


def _train_in_child(
    cell: HandOver,
    store: Store,
    variant: ConfinedPath,
    folder: CellFolder,
    lock: locks.Lock,
    session: SweepSession,
) -> str:
    """Train the cell in a child process; return the job's outcome."""

    def on_poll(pid: int) -> None:
        presence.check(store)
        if not lock.beat(pid):
            raise _CellLeftError(_lost(folder))
        if session.owner_dead:
            log_line(f"{folder.id} is left: its sweep's process has ended")
            raise _CellLeftError(STOPPED)

    request = worker.cell_request(cell.config, variant, folder)
    limits = cell.config["limits"]
    try:
        worker.run_in_child(
            "cell", request, Limits(limits["minutes"], limits["memory_gb"]), on_poll
        )
    except _CellLeftError as error:
        return error.outcome
    except XrgsError as error:
        return _after_error(error, store, folder, lock)
    return folder.state().name


def _after_error(error: XrgsError, store: Store, folder: CellFolder, lock: locks.Lock) -> str:
    """Return the outcome of a cell whose process failed, and write it where that is its fault."""
    if presence.is_gone(store):
        return GONE
    # The cell is another process's now, though its own may have failed before.
    if isinstance(error, worker.AttemptLostError) or not lock.is_held():
        return _lost(folder)
    for kind, outcome in _NO_FAULT.items():
        if isinstance(error, kind):
            log_line(f"{folder.id} is left: {error}")
            return outcome
    state = folder.state().name
    if state in {"done", "unknown"}:  # it may be finished although its process died at its exit
        return state
    folder.fail(str(error))
    log_line(f"{folder.id} failed: {error}")
    return "failed"
