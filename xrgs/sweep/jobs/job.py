"""Runs one planned cell in a process of its own, on whatever machine the launcher has chosen.

A cell that fails is a state and not an exception, so that no launcher drops the rest of its batch.
"""

from __future__ import annotations

import socket
import time
from contextlib import contextmanager
from itertools import cycle
from typing import TYPE_CHECKING

from xrgs.errors import StoreError, UnreadableError, XrgsError
from xrgs.runtime import lease
from xrgs.runtime.machine import gpus
from xrgs.runtime.progress import log_line
from xrgs.splat.backend import arithmetic
from xrgs.store.attempts import begin_attempt
from xrgs.store.identity import changed_code
from xrgs.sweep import build_variants
from xrgs.sweep.jobs import worker
from xrgs.sweep.jobs.supervise import Limits

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from xrgs.config import Conf
    from xrgs.store.cell_folder import CellFolder
    from xrgs.store.schema import Identity
    from xrgs.store.store import Store
    from xrgs.sweep.session import SweepSession

#: Outcomes of a job other than the states of a cell. LOCKED: another sweep is training the cell.
#: STOPPED: the sweep is over, or no further job may begin. UNWRITABLE: the store can't be written.
#: GONE: the store is no longer there.
#: INTERRUPTED: a signal asked the cell's process to end, and the next sweep continues the cell.
LOCKED, STOPPED, UNWRITABLE, GONE = "locked", "stopped", "unwritable", "gone"
INTERRUPTED = "interrupted"
#: Reasons to begin no further job of a sweep, see `SweepSession.stop`.
FAIL_FAST, STORE_FULL = "fail_fast, and a cell failed", "the store can't be written"
#: Outcomes of errors that are no fault of the cell: the next sweep trains the cell again.
_NO_FAULT = {
    worker.InterruptedWorkError: INTERRUPTED,
    worker.UnwritableError: UNWRITABLE,
}


#: Seconds between two looks for a free GPU.
_GPU_POLL_S = 0.2


class _CellLeftError(XrgsError):
    """This job leaves its cell unfinished, through no fault of the cell."""

    def __init__(self, outcome: str) -> None:
        super().__init__(outcome)
        self.outcome = outcome


def run_job(session: SweepSession, store: Store, cell_id: str, name: str) -> str:
    """Run one cell of a sweep, unless there is a reason not to.

    Args:
        session: The call of `xrgs-sweep` that the job belongs to.
        store: The store. The cell's folder in it has the cell's config and identity.
        cell_id: The cell's id.
        name: The cell's name for people.

    Returns:
        The cell's state, or `LOCKED`, `STOPPED`, `UNWRITABLE`, `GONE` or `INTERRUPTED`.

    Raises:
        XrgsError: The installed code is not the planned one, or the variant of the cell is missing,
            or trimmed and its images can't be made again.
    """
    if not session.folder.is_dir():
        log_line(
            f"{session.folder} is not there, so that {cell_id} is left: hydra.sweep.dir must be a"
            " folder that every machine of the sweep can read"
        )
        return GONE
    if session.stopped:
        return STOPPED
    cell, conf = store.cell(cell_id), None
    try:
        conf = cell.config()
        outcome = _run_under_lease(cell, name, conf, store, session)
    except (OSError, StoreError) as error:
        outcome = _outcome_of(error, store)
        if outcome != GONE:
            log_line(f"store={store.path}: {error}")
    if outcome == UNWRITABLE:
        session.stop(STORE_FULL)
    if conf is not None and conf.fail_fast and outcome == "failed":
        session.stop(FAIL_FAST)
    return outcome


def _outcome_of(error: OSError | StoreError, store: Store) -> str:
    """Return the outcome of a job after an OSError; raise an error of a damaged file again."""
    if store.is_gone:
        return GONE
    if isinstance(error, StoreError) and not isinstance(error, UnreadableError):
        raise error
    return UNWRITABLE if isinstance(error, OSError) and worker.unwritable(error) else "failed"


def _run_under_lease(
    cell: CellFolder, name: str, conf: Conf, store: Store, session: SweepSession
) -> str:
    """Train the cell unless another process is training it, or has finished it meanwhile."""
    identity = cell.identity()
    # The plan has verified the variant's files, and the child process verifies them again. The
    # images of a trimmed variant are made again here.
    variant = store.variants / identity.variant
    if not variant.is_dir():
        build_variants.restore(conf, store, identity.variant)
    if not variant.is_dir():
        raise XrgsError(f"{name}: its variant {variant} is missing")
    held = lease.acquire(store.leases, cell.id)
    if held is None:
        log_line(f"{cell.id}: another sweep is training this cell; this sweep leaves it")
        return LOCKED
    try:
        state = cell.state()
        if state.unreadable:
            log_line(f"{cell.id} is left: {state.reason}")
        if state.unreadable or state.name == "done":  # another sweep has finished it meanwhile
            return state.name
        _check_code(name, cell.id, conf, identity)
        if not begin_attempt(cell, held.beat):
            return _lost(cell)
        if not session.brief:
            log_line(f"{name}: training cell {cell.id}")
        return _train_in_child(cell, conf, store, variant, held, session)
    finally:
        held.release()


def _check_code(name: str, cell_id: str, conf: Conf, planned: Identity) -> None:
    """Refuse to train with other code or other arithmetic than the cell was planned with.

    Raises:
        XrgsError: They differ; the message names the parts of the program that do.
    """
    if parts := changed_code(planned):
        raise XrgsError(
            f"{name}: cell {cell_id} was planned with other code than is installed here and now"
            f" ({', '.join(parts)}). Install the same version of xrgs wherever cells are trained,"
            " and start the sweep again"
        )
    here = arithmetic(conf.splat.backend)
    if planned.arithmetic != here:
        raise XrgsError(
            f"{name}: cell {cell_id} was planned with the arithmetic {planned.arithmetic}, and this"
            f" machine has {here}, which gives other last digits. Start the sweep on a machine of"
            " the same kind as the training ones, or set splat.backend=torch"
        )


def _lost(folder: CellFolder) -> str:
    """Say that the lease is lost; this job does not touch the cell's folder any more."""
    log_line(
        f"{folder.id} is left: this process gave no sign of life for too long, and another has"
        " taken over"
    )
    return LOCKED


def _train_in_child(
    cell: CellFolder,
    conf: Conf,
    store: Store,
    variant: Path,
    held: lease.Lease,
    session: SweepSession,
) -> str:
    """Train the cell in a child process; return the job's outcome."""

    def on_poll(_: int) -> None:
        store.check_not_gone()
        if held.lost:
            raise _CellLeftError(_lost(cell))
        if session.owner_dead:
            log_line(f"{cell.id} is left: its sweep's process has ended")
            raise _CellLeftError(STOPPED)

    limits = Limits(conf.limits.minutes, conf.limits.memory_gb)
    try:
        request = worker.cell_request(variant, cell)
        with _own_gpu(session, conf.splat.backend) as environment:
            answer = worker.run_in_child("cell", request, limits, on_poll, environment)
    except _CellLeftError as error:
        return error.outcome
    except XrgsError as error:
        return _after_error(error, store, cell, held)
    for line in () if session.brief else answer["found"]:
        log_line(f"{cell.id}: {line}")
    return cell.state().name


@contextmanager
def _own_gpu(session: SweepSession, backend: str) -> Iterator[dict[str, str]]:
    """Hold one of the GPUs that this job sees; yield the variable that shows it to the child.

    Clusters show a job the GPU that it has asked for. On one machine all jobs of a sweep see all
    GPUs, and run no more at once than there are (`xrgs.sweep.launch.one_cell_a_gpu`).
    """
    names = gpus() if backend == "gsplat" else []
    if len(names) < 2:
        yield {}
        return
    folder, host = session.folder / "gpus", socket.gethostname()
    folder.mkdir(exist_ok=True)
    for name in cycle(names):
        held = lease.acquire(folder, f"{host} {name}")
        if held is not None:
            try:
                yield {"CUDA_VISIBLE_DEVICES": name}
            finally:
                held.release()
            return
        time.sleep(_GPU_POLL_S)


def _after_error(error: XrgsError, store: Store, folder: CellFolder, held: lease.Lease) -> str:
    """Return the outcome after the cell's process failed; write the reason if the cell failed."""
    if store.is_gone:
        return GONE
    # Another process owns the cell now, and may have failed it or finished it.
    if isinstance(error, worker.AttemptLostError) or not held.beat():
        return _lost(folder)
    for kind, outcome in _NO_FAULT.items():
        if isinstance(error, kind):
            log_line(f"{folder.id} is left: {error}")
            return outcome
    state = folder.state()
    # Its process may have died after it had finished the cell.
    if state.name == "done" or state.unreadable:
        return state.name
    folder.fail(str(error))
    log_line(f"{folder.id} failed: {error}")
    return "failed"
