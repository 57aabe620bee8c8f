"""What a launcher runs, perhaps on another machine: one cell, in a process of its own.

A cell's failure is a state and no exception, so that no launcher drops the rest of its batch.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

from xrgs.capture import scenes, variant
from xrgs.errors import XrgsError
from xrgs.experiment.identity import cell_identity
from xrgs.experiment.store import Store
from xrgs.runtime.progress import say
from xrgs.safeio.hashing import digest
from xrgs.splat.backend import resolve_backend
from xrgs.sweep import locks
from xrgs.sweep.jobs import worker
from xrgs.sweep.jobs.supervise import Limits

if TYPE_CHECKING:
    from xrgs.config import Conf
    from xrgs.experiment.store import CellFolder

#: What a job ends with beside a cell's states: another sweep trains the cell; the sweep is over, or
#: was told to start nothing more; the store takes no more.
LOCKED, STOPPED, UNWRITABLE = "locked", "stopped", "unwritable"
#: Why no job of a call begins any more, see `SweepSession.stop`.
FAIL_FAST, STORE_FULL = "fail_fast, and a cell failed", "the store can't be written"


class _LeftError(XrgsError):
    """The cell is left, for no fault of its own."""

    def __init__(self, outcome: str, reason: str) -> None:
        super().__init__(reason)
        self.outcome = outcome
        """What the job ends with."""


@dataclass(frozen=True)
class SweepSession:
    """One call of `xrgs-sweep`, as its jobs know it: by a folder of its own."""

    folder: Path

    def begin(self) -> None:
        """Say which process it is."""
        locks.sign(self.folder / "sweep")

    def stop(self, reason: str) -> None:
        """Have no job begin any more, and say why; the first reason stays."""
        # A full disk may have room for a name, and for no word in it.
        with suppress(OSError), (self.folder / "stopped").open("x", encoding="utf-8") as stream:
            stream.write(reason)

    @cached_property
    def _owner(self) -> locks.Owner | None:
        return locks.signature(self.folder / "sweep")

    @property
    def owner_dead(self) -> bool:
        """Whether its process is no more; from another machine that can't be told, and is False."""
        return self._owner is not None and self._owner.here and not self._owner.lives

    @property
    def stopped(self) -> str:
        """Why no job is to begin any more; empty while they may."""
        file = self.folder / "stopped"
        if file.exists():
            return file.read_text(encoding="utf-8", errors="replace") or f"there is {file}"
        return "the sweep is gone" if self.owner_dead else ""


def run_job(conf: Conf, call: SweepSession) -> str:
    """Run one cell of a sweep, unless there is a reason not to.

    Args:
        conf: the cell's.
        call: of `xrgs-sweep`, that the job belongs to.

    Returns:
        The cell's state, or `LOCKED`, `STOPPED` or `UNWRITABLE`.
    """
    if call.stopped:
        return STOPPED
    store = Store(Path(conf.store))
    try:
        outcome = _run_alone(conf, store, call)
    except OSError as error:
        if not worker.unwritable(error):
            raise
        say(f"store={store.path}: {error}")
        outcome = UNWRITABLE
    if outcome == UNWRITABLE:
        call.stop(STORE_FULL)
    if conf.fail_fast and outcome == "failed":
        call.stop(FAIL_FAST)
    return outcome


def _run_alone(conf: Conf, store: Store, call: SweepSession) -> str:
    """Run the cell if nobody else does, and nobody has meanwhile."""
    # The plan has verified it, and the child does, which reads it anyway.
    wanted = variant.key(conf.scene, conf.variant)
    found = min(store.variants.glob(f"{wanted}-*"), default=None)
    if found is None:
        raise XrgsError(f"{scenes.label(conf.scene)}: its variant is gone from {store.variants}")
    # Named, so that the child can't choose another one than the identity says.
    conf.splat.backend = resolve_backend(conf.splat.backend)
    identity = cell_identity(conf, found.name)
    folder = store.cell(digest(identity))
    lock = locks.acquire(store.locks, folder.id)
    if lock is None:
        say(f"{folder.id}: another sweep is training it; left to that")
        return LOCKED
    try:
        if folder.state().name == "done":  # by another sweep, since this one was planned
            return "done"
        folder.begin(asdict(conf), identity)
        say(f"{scenes.label(conf.scene)} / seed {conf.seed}: training cell {folder.id}")
        return _train(conf, found, folder, lock, call)
    finally:
        lock.release()


def _train(
    conf: Conf, found: Path, folder: CellFolder, lock: locks.Lock, call: SweepSession
) -> str:
    request = {"conf": asdict(conf), "variant": str(found), "cell": str(folder.path)}

    def on_poll(pid: int) -> None:
        if not lock.beat(pid):
            why = "this process was away too long, and another has taken the cell over"
            raise _LeftError(LOCKED, f"{folder.id}: {why}")
        if call.owner_dead:
            raise _LeftError(STOPPED, f"{folder.id}: the sweep that started it is gone")

    try:
        worker.run("cell", request, Limits(**asdict(conf.limits)), on_poll)
    except _LeftError as error:
        say(str(error))
        return error.outcome
    except worker.UnwritableError as error:
        # No fault of the cell's: it stays unfinished, and is run again without being asked for.
        say(f"{folder.id} stopped: {error}")
        return UNWRITABLE
    except XrgsError as error:
        state = folder.state().name
        if state != "done":  # it may have ended, and its process died on the way out
            folder.fail(str(error))
            say(f"{folder.id} failed: {error}")
    return folder.state().name
