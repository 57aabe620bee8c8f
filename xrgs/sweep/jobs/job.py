"""Runs one planned cell in a process of its own, on whatever machine the launcher has chosen.

A cell that fails is a state and not an exception, so that no launcher drops the rest of its batch.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from xrgs.errors import XrgsError
from xrgs.experiment.store import Store
from xrgs.runtime.progress import log_line
from xrgs.sweep import locks
from xrgs.sweep.jobs import worker
from xrgs.sweep.jobs.supervise import Limits

if TYPE_CHECKING:
    from xrgs.experiment.cell_folder import CellFolder
    from xrgs.safeio.confined import ConfinedPath
    from xrgs.sweep.session import HandOver, SweepSession

#: Outcomes of a job beside the states of a cell. LOCKED: another sweep is training the cell.
#: STOPPED: the sweep is over, or no further job may begin. UNWRITABLE: the store can't be written.
LOCKED, STOPPED, UNWRITABLE = "locked", "stopped", "unwritable"
#: Reasons for which no further job of a sweep begins, see `SweepSession.stop`.
FAIL_FAST, STORE_FULL = "fail_fast, and a cell failed", "the store can't be written"


class _CellLeftError(XrgsError):
    """This job has to leave its cell unfinished, which is no fault of the cell."""

    def __init__(self, outcome: str, reason: str) -> None:
        super().__init__(reason)
        self.outcome = outcome
        """The outcome of the job."""


def run_job(session: SweepSession, cell_id: str) -> str:
    """Run one cell of a sweep, unless there is a reason not to.

    Args:
        session: The call of `xrgs-sweep` that the job belongs to.
        cell_id: The cell's id; the session's folder holds its config and identity.

    Returns:
        The cell's state, or `LOCKED`, `STOPPED` or `UNWRITABLE`.

    Raises:
        XrgsError: The cell was not handed over by this sweep's plan, its code is not the planned
            one, or its variant is missing.
    """
    if session.stopped:
        return STOPPED
    cell = session.read(cell_id)
    store = Store(Path(cell.config["store"]))
    try:
        outcome = _run_under_lock(cell, store, session)
    except OSError as error:
        if not worker.unwritable(error):
            raise
        log_line(f"store={store.path}: {error}")
        outcome = UNWRITABLE
    if outcome == UNWRITABLE:
        session.stop(STORE_FULL)
    if cell.config["fail_fast"] and outcome == "failed":
        session.stop(FAIL_FAST)
    return outcome


def _run_under_lock(cell: HandOver, store: Store, session: SweepSession) -> str:
    """Train the cell unless another process is training it, or has finished it meanwhile."""
    # The plan has verified the variant's files, and the child process verifies them again.
    variant = store.variants / cell.variant_id
    if not variant.is_dir():
        raise XrgsError(f"{cell.name}: its variant {variant} is missing")
    folder = store.cell(cell.cell_id)
    lock = locks.acquire(store.locks, folder.id)
    if lock is None:
        log_line(f"{folder.id}: another sweep is training this cell; this sweep leaves it")
        return LOCKED
    try:
        if folder.state().name == "done":  # finished by another sweep since this one was planned
            return "done"
        cell.check_code()
        attempt = folder.begin(cell.config, cell.identity)
        log_line(f"{cell.name}: training cell {folder.id}")
        return _train_in_child(cell, variant, attempt, lock, session)
    finally:
        lock.release()


def _train_in_child(
    cell: HandOver,
    variant: ConfinedPath,
    folder: CellFolder,
    lock: locks.Lock,
    session: SweepSession,
) -> str:
    """Train the cell in a child process; return the job's outcome."""

    def on_poll(pid: int) -> None:
        if not lock.beat(pid):
            why = "this process gave no sign of life for too long, and another has taken over"
            raise _CellLeftError(LOCKED, f"{folder.id} is left: {why}")
        if session.owner_dead:
            raise _CellLeftError(STOPPED, f"{folder.id} is left: its sweep's process has ended")

    request = worker.cell_request(cell.config, variant, folder)
    limits = cell.config["limits"]
    try:
        worker.run_in_child(
            "cell", request, Limits(limits["minutes"], limits["memory_gb"]), on_poll
        )
    except _CellLeftError as error:
        log_line(str(error))
        return error.outcome
    except worker.AttemptLostError as error:
        log_line(f"{folder.id} is left: {error}")
        return LOCKED
    except worker.UnwritableError as error:
        # No fault of the cell: it stays unfinished, and the next sweep trains it without `retry`.
        log_line(f"{folder.id} stopped: {error}")
        return UNWRITABLE
    except XrgsError as error:
        state = folder.state().name
        if state != "done":  # the cell may be finished although its process died at its exit
            folder.fail(str(error))
            log_line(f"{folder.id} failed: {error}")
    return folder.state().name
