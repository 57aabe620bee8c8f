"""A job: one cell, or one variant, in a child process with limits, on the launcher's machine.

Hydra's launcher calls `run_hydra_job`, which trains one planned cell under the cell's lease. The
training is in a child process, which a kill or a segfault ends and nothing else. The parent runs
torch only for the report. The child runs `python -m xrgs.sweep.job WORK REQUEST ANSWER`: the kind
of work, the file of its arguments, and the file for its answer.

A cell that fails is a state and not an exception, so that no launcher drops the rest of its batch.
"""

from __future__ import annotations

import errno
import faulthandler
import logging
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from functools import cached_property
from itertools import cycle
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import msgspec

from xrgs.config import Conf, LimitsConf
from xrgs.errors import StoreError, UnreadableError, XrgsError
from xrgs.mixture.paths import trimmed_folder
from xrgs.runtime import lease, machine
from xrgs.runtime.machine import gpus, set_huge_pages, set_portable_blas, set_portable_mkl
from xrgs.runtime.progress import log_line
from xrgs.runtime.signals import StopRequest, StopSignal, end_by_sigterm
from xrgs.runtime.streams import guard_streams, log_to_stderr, say
from xrgs.safeio.atomic import write_json
from xrgs.safeio.files import is_transient, read_bytes
from xrgs.safeio.records import read_struct
from xrgs.safeio.sanitize import for_line
from xrgs.splat.backend import arithmetic
from xrgs.store.attempts import begin_attempt
from xrgs.store.cell_folder import LOG, CellFolder
from xrgs.store.identity import changed_code
from xrgs.store.schema import Identity
from xrgs.store.store import Store

if TYPE_CHECKING:
    from omegaconf import DictConfig

#: Outcomes of a job other than the states of a cell. LOCKED: another process trains the cell.
#: STOPPED: the sweep is over, or no further job may begin. UNWRITABLE: the store can't be written.
#: GONE: the store is no longer there. INTERRUPTED: a signal asked the cell's process to end; the
#: next sweep continues the cell.
LOCKED, STOPPED, UNWRITABLE, GONE = "locked", "stopped", "unwritable", "gone"
INTERRUPTED = "interrupted"
#: Reasons to begin no further job of a sweep, see `SweepSession.stop`.
FAIL_FAST, STORE_FULL = "fail_fast, and a cell failed", "the store can't be written"
#: The message when the store can't be written any more.
NOTHING_LOST = (
    "Finished cells are kept: when there is room to write, run the same command again to continue."
)
#: The most bytes that are read of the file `stopped` of a session.
_MAX_REASON = 1 << 12
#: Seconds between two looks for a free GPU.
_GPU_POLL_S = 0.2
#: Errors of a file system that takes no more writes.
_UNWRITABLE = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EIO})
#: Signals that ask a process to end: `scancel` and a cluster's time limits send them, and `kill`.
_ASK_TO_END = frozenset(
    {signal.SIGHUP, signal.SIGINT, signal.SIGTERM, signal.SIGUSR1, signal.SIGUSR2}
)
#: Seconds between two polls of the child.
_POLL_S = 0.2
#: Seconds that the child has after SIGTERM to write its checkpoint; fewer after it has exceeded a
#: limit.
_GRACE_S, _LIMIT_GRACE_S = 60.0, 5.0
#: After this many seconds of waiting for the child's end, a message says so.
_SILENT_S = 1.0
#: The child writes its stack at this signal.
_STACK_SIGNAL = signal.SIGUSR1
#: Waits for the end of its standard input, a pipe into which nothing is written, and then kills the
#: process group. It ignores the signals that ask the group to end.
_WATCHER = "trap '' TERM INT HUP; read -r _; kill -s KILL -- -$1"


@dataclass(frozen=True)
class ProcessEnd:
    """How a process ended."""

    code: int
    """Its exit code, or minus the number of the signal that ended it."""
    reason: str = ""
    """The limit that it exceeded."""


class Answer(msgspec.Struct, frozen=True):
    """The child's answer when its work has ended."""

    result: dict[str, Any] = {}
    error: str | None = None
    """Why the work failed."""
    outcome: str = "failed"
    """The outcome of work that failed, see `WorkError`."""


class WorkError(XrgsError):
    """Work in a child process has no result.

    Its outcome is `failed`, or that of work that is not known to be faulty: `LOCKED`, `STOPPED`,
    `UNWRITABLE` or `INTERRUPTED`.
    """

    def __init__(self, reason: str, outcome: str = "failed") -> None:
        super().__init__(reason)
        self.outcome = outcome


@dataclass(frozen=True)
class SweepSession:
    """The folder of one call of `xrgs-sweep`, by which its jobs know the call.

    It is in the store, so that jobs on other machines see it. Its file `sweep` names the call's
    process, and its file `stopped` says why no further job may begin.
    """

    folder: Path
    brief: bool = False
    """Whether the jobs print only failures, as for `xrgs-train`."""

    @property
    def exists(self) -> bool:
        """Whether the folder is there and belongs to a call."""
        return (self.folder / "sweep").is_file()

    def stop(self, reason: str) -> None:
        """Let no further job begin; keep the reason, unless an earlier one is there."""
        # A full disk may have room for the file's name and none for the reason in it.
        with suppress(OSError), (self.folder / "stopped").open("xb") as stream:
            stream.write(reason.encode())

    def end(self) -> None:
        """Remove the folder when no job is left, unless a launcher has left its logs in it."""
        files = {self.folder / "sweep", self.folder / "stopped"}
        with suppress(OSError):  # a folder that stays disturbs nobody
            for job_folder in set(self.folder.iterdir()) - files:
                job_folder.rmdir()  # fails where there are logs: then all of the folder stays
            for file in files:
                file.unlink(missing_ok=True)
            self.folder.rmdir()

    @cached_property
    def _owner(self) -> lease.Owner | None:
        return lease.signature(self.folder / "sweep")

    @property
    def owner_dead(self) -> bool:
        """Whether the process of this call has ended; False if it ran on another machine."""
        return self._owner is not None and self._owner.here and not self._owner.lives

    @property
    def stopped(self) -> str:
        """Why no further job may begin; empty while they may."""
        file = self.folder / "stopped"
        try:
            reason = read_bytes(file, _MAX_REASON).decode(errors="replace")
            return for_line(reason) or f"{file} exists"
        except FileNotFoundError:
            if not self.folder.exists():
                return f"{self.folder} is no longer there"
        except OSError as error:
            if not is_transient(error):  # something else has that name
                return f"{file} exists"
        return "the process of the sweep has ended" if self.owner_dead else ""


# A cell's job, in the process that the launcher has started


def run_hydra_job(cfg: DictConfig) -> str:
    """Run one job of a sweep: Hydra's launcher calls this, here or on another machine.

    The config has Hydra's settings, and `cell`, `store` and `name` (`xrgs.sweep.study`).
    """
    # The child, which imports this file too, starts sooner without Hydra.
    from hydra.core.hydra_config import HydraConfig
    from hydra.errors import CompactHydraException
    from omegaconf import OmegaConf

    if "cell" not in cfg:
        raise CompactHydraException("hydra.mode must be MULTIRUN, as conf/config.yaml sets it")
    hydra_conf: Any = HydraConfig.get()
    brief = OmegaConf.select(hydra_conf, "sweeper.brief", default=False)
    session = SweepSession(Path(hydra_conf.sweep.dir), brief)
    outcome = run_job(session, Store(Path(cfg.store)), cfg.cell, cfg.name)
    if session.owner_dead:  # a worker of joblib would wait for ever to hand over its answer
        os._exit(os.EX_TEMPFAIL)
    if outcome == INTERRUPTED and os.environ.get("SUBMITIT_EXECUTOR") == "slurm":
        sys.exit(os.EX_TEMPFAIL)  # no answer yet: SLURM may be about to run this job again
    return outcome


def run_job(session: SweepSession, store: Store, cell_id: str, name: str) -> str:
    """Run one cell of a sweep, unless there is a reason not to; return its outcome or its state.

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
        if store.is_gone:
            return GONE
        if isinstance(error, StoreError) and not isinstance(error, UnreadableError):
            raise
        log_line(f"store={store.path}: {error}")
        full = isinstance(error, OSError) and unwritable(error)
        outcome = UNWRITABLE if full else "failed"
    if outcome == UNWRITABLE:
        session.stop(STORE_FULL)
    if conf is not None and conf.fail_fast and outcome == "failed":
        session.stop(FAIL_FAST)
    return outcome


def _run_under_lease(
    cell: CellFolder, name: str, conf: Conf, store: Store, session: SweepSession
) -> str:
    """Train the cell unless another process is training it, or has finished it meanwhile."""
    identity = cell.identity()
    # The plan has verified the variant's files, and the child process verifies them again. The
    # images of a trimmed variant are made again here.
    variant = store.variants / identity.variant
    if not variant.is_dir():
        restore_images(conf, store, identity.variant)
    if not variant.is_dir():
        raise XrgsError(f"{name}: its variant {variant} is missing")
    with lease.held(store.leases, cell.id) as cell_lease:
        if cell_lease is None:
            log_line(f"{cell.id}: another sweep is training this cell; this sweep leaves it")
            return LOCKED
        state = cell.state()
        if state.unreadable:
            log_line(f"{cell.id} is left: {state.reason}")
        if state.unreadable or state.name == "done":  # another sweep has finished it meanwhile
            return state.name
        _check_code(name, cell.id, conf, identity)
        if not begin_attempt(cell, cell_lease.beat):
            return _lost(cell)
        if not session.brief:
            log_line(f"{name}: training cell {cell.id}")
        return _train_in_child(cell, conf, store, variant, cell_lease, session)


def _check_code(name: str, cell_id: str, conf: Conf, planned: Identity) -> None:
    """Refuse to train with other code or other arithmetic than the cell was planned with."""
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
            raise WorkError("another process has taken over", LOCKED)
        if session.owner_dead:
            raise WorkError("its sweep's process has ended", STOPPED)

    try:
        request = cell_request(variant, cell)
        with _own_gpu(session, conf.splat.backend) as environment:
            answer = run_in_child("cell", request, conf.limits, on_poll, environment)
    except XrgsError as error:
        return _after_error(error, store, cell, held)
    for line in () if session.brief else answer["found"]:
        log_line(f"{cell.id}: {line}")
    return cell.state().name


@contextmanager
def _own_gpu(session: SweepSession, backend: str) -> Iterator[dict[str, str]]:
    """Hold one of the GPUs that this job sees; yield the variable that shows it to the child.

    Clusters show a job the GPU that it has asked for. On one machine all jobs of a sweep see all
    GPUs, and run no more at once than there are (`xrgs.sweep.launchers.one_cell_a_gpu`).
    """
    names = gpus() if backend == "gsplat" else []
    if len(names) < 2:
        yield {}
        return
    folder, host = session.folder / "gpus", socket.gethostname()
    folder.mkdir(exist_ok=True)
    for name in cycle(names):
        with lease.held(folder, f"{host} {name}") as free:
            if free is not None:
                yield {"CUDA_VISIBLE_DEVICES": name}
                return
        time.sleep(_GPU_POLL_S)


def _after_error(error: XrgsError, store: Store, folder: CellFolder, held: lease.Lease) -> str:
    """Return the outcome after the cell's process failed; write the reason if the cell failed."""
    if store.is_gone:
        return GONE
    outcome = error.outcome if isinstance(error, WorkError) else "failed"
    # Another process owns the cell now, and may have failed it or finished it.
    if outcome == LOCKED or not held.beat():
        return _lost(folder)
    if outcome != "failed":
        log_line(f"{folder.id} is left: {error}")
        return outcome
    state = folder.state()
    # Its process may have died after it had finished the cell.
    if state.name == "done" or state.unreadable:
        return state.name
    folder.fail(str(error))
    log_line(f"{folder.id} failed: {error}")
    return "failed"


# Work in a child process


def restore_images(conf: Conf, store: Store, variant_id: str) -> None:
    """Make the images of a variant again, in a child process, if it is trimmed.

    Scene and variant are taken from `conf`, the config of any of its cells.

    Raises:
        XrgsError: The photographs are missing or give other images, or the disk is full.
    """
    if not trimmed_folder(store.variants, variant_id).is_dir():
        return
    log_line(f"variant {variant_id}: making the images again that xrgs-store trim has removed")
    request = {"conf": asdict(conf), "store": str(store.path), "variant": variant_id}
    run_in_child("variant", request, None, lambda _: store.check_not_gone())


def run_in_child(
    work: str,
    request: Mapping[str, Any],
    limits: LimitsConf | None = None,
    on_poll: Callable[[int], None] = lambda _: None,
    environment: Mapping[str, str] = MappingProxyType({}),
) -> dict[str, Any]:
    """Do one piece of work, see `_WORK`, in a child process and return its answer.

    Request and answer are plain JSON values; other arguments are as for `run_supervised`.

    Raises:
        WorkError: The work has no result; the message is the reason.
    """
    set_portable_blas()  # before the child loads it
    set_huge_pages()  # before the child allocates anything
    try:
        temporary = tempfile.TemporaryDirectory(prefix="xrgs-")
    except FileNotFoundError as error:  # /tmp can't be written, nor any other usual place
        raise WorkError(f"{error.strerror}: set TMPDIR to a folder for them", UNWRITABLE) from error
    with temporary as name:
        files = Path(name)
        request_file, answer_file = files / "request.json", files / "answer.json"
        write_json(request_file, dict(request))
        # -P keeps the working folder off sys.path: the child imports the package its parent did.
        child = [sys.executable, "-P", "-m", "xrgs.sweep.job"]
        command = [*child, work, str(request_file), str(answer_file)]
        ended = run_supervised(command, limits, on_poll, environment)
        if ended.reason:
            raise WorkError(ended.reason)
        if not answer_file.exists() and ended.code == os.EX_IOERR:
            reason = f"{name} took no answer: make room there, or set TMPDIR to another folder"
            raise WorkError(reason, UNWRITABLE)
        if not answer_file.exists():
            raise _death(ended.code)
        answer = read_struct(answer_file, Answer)
    if answer.error is not None:
        raise WorkError(answer.error, answer.outcome)
    return answer.result


def cell_request(variant: Path, cell: CellFolder) -> dict[str, Any]:
    """Return the request to train a cell, after `begin_attempt` has put its folder in place."""
    paths = {"variant": str(variant.absolute()), "cell": str(cell.path.absolute())}
    return {**paths, "id": cell.id, "inode": cell.path.stat().st_ino}


def unwritable(error: OSError) -> bool:
    """Return whether an error says that a file system takes no more writes."""
    return error.errno in _UNWRITABLE


def _death(code: int) -> WorkError:
    if code >= 0:
        return WorkError(f"its process ended with exit code {code} before it answered")
    number = signal.Signals(-code)
    hint = " (out of memory?)" if number == signal.SIGKILL else ""
    reason = f"its process was ended by {number.name}{hint}"
    return WorkError(reason, INTERRUPTED if number in _ASK_TO_END else "failed")


def run_supervised(
    command: Sequence[str],
    limits: LimitsConf | None = None,
    on_poll: Callable[[int], None] = lambda _: None,
    environment: Mapping[str, str] = MappingProxyType({}),
) -> ProcessEnd:
    """Run a command, in a session of its own, until it ends or exceeds a limit.

    Its standard input is a pipe that ends when this process does (see `follow_parent`). Variables
    of `environment` are added to those of this process. `on_poll` is called again and again with
    the process id; an exception that it raises ends the process and is raised here.
    """
    child = subprocess.Popen(  # noqa: S603
        command, stdin=subprocess.PIPE, start_new_session=True, env=os.environ | environment
    )
    reason = ""
    try:
        reason = _watch(child, limits, on_poll)
    finally:
        _end(child, exceeded=bool(reason))
    return ProcessEnd(child.returncode, reason)


def _watch(
    child: subprocess.Popen[bytes], limits: LimitsConf | None, on_poll: Callable[[int], None]
) -> str:
    """Wait until the child ends or exceeds a limit; return which limit, or nothing.

    RLIMIT_AS is no substitute: torch alone maps several times the memory that it uses.
    """
    minutes, memory_gb = (limits.minutes, limits.memory_gb) if limits else (0.0, 0.0)
    start, pause = time.monotonic(), 0.01
    while child.poll() is None:
        if minutes and time.monotonic() - start > 60 * minutes:
            return f"it took longer than limits.minutes={minutes:g} and was ended"
        if memory_gb and (used := machine.resident_bytes(child.pid) / 1e9) > memory_gb:
            return (
                f"out of memory: it used {used:.2f} GB, more than limits.memory_gb={memory_gb:g},"
                " and was ended"
            )
        on_poll(child.pid)
        time.sleep(pause)
        pause = min(_POLL_S, 1.5 * pause)
    return ""


def _end(child: subprocess.Popen[bytes], *, exceeded: bool) -> None:
    """End the child and its children, by SIGTERM first, so that they can end in order."""
    if child.poll() is None:
        if exceeded:  # its stack tells what took so long
            child.send_signal(_STACK_SIGNAL)
        _signal(child, signal.SIGTERM)
        if not _ends_within(child, _LIMIT_GRACE_S if exceeded else _SILENT_S) and not exceeded:
            log_line(
                f"waiting at most {_GRACE_S:.0f} s for the cell to keep its state; another Ctrl-C"
                " ends it at once"
            )
            _ends_within(child, _GRACE_S)
    _signal(child, signal.SIGKILL)
    child.wait()
    if child.stdin is not None:
        child.stdin.close()


def _ends_within(child: subprocess.Popen[bytes], seconds: float) -> bool:
    with suppress(subprocess.TimeoutExpired):
        child.wait(seconds)
    return child.returncode is not None


def _signal(child: subprocess.Popen[bytes], number: int) -> None:
    # The group has no process any more, or none but zombies.
    with suppress(ProcessLookupError, PermissionError):
        os.killpg(child.pid, number)


# In the child


def _make_variant(request: Mapping[str, Any]) -> dict[str, Any]:
    """Build a variant, or make the images of the one that is named again."""
    from xrgs.composing import from_dict
    from xrgs.mixture import variant
    from xrgs.store.trimming import restore_variant

    log_to_stderr()
    set_portable_mkl()
    with machine.without_collections():
        import torch  # noqa: F401  scenes and photographs are made with it
    conf, store = from_dict(request["conf"]), Store(Path(request["store"]))
    if (trimmed := request.get("variant")) is None:
        built = variant.build(conf.scene, conf.variant, store.variants, store.scenes)
        return {"variant": built.id}
    restore_variant(store.variants, trimmed, conf.scene, conf.variant, store.scenes)
    return {}


def _run_cell(request: Mapping[str, Any]) -> dict[str, Any]:
    _enter_folder(Path(request["cell"]), request["inode"])
    with machine.without_collections():
        from xrgs.mixture import variant
        from xrgs.store import cell

    stop = StopRequest()
    stop.watch()
    faulthandler.register(_STACK_SIGNAL, 2)
    log_to_stderr(logging.INFO)
    folder = CellFolder(Path(), request["id"])
    try:
        cell.run_cell(folder.config(), variant.load(Path(request["variant"])), folder, stop)
    except StopSignal:
        end_by_sigterm()
    return {"found": folder.summary().found}


def _enter_folder(folder: Path, inode: int) -> None:
    """Make an attempt's folder the working directory, and its log the target of all output.

    The working directory stays this very folder when another folder takes its name. So a process
    that has lost its cell never writes into the files of the new owner.

    Raises:
        WorkError: Another folder has the name already, or none has.
    """
    lost = WorkError(f"{folder}: another attempt at the cell has begun", LOCKED)
    try:
        os.chdir(folder)
        if Path.cwd().stat().st_ino != inode:
            raise lost
        log = os.open(LOG, os.O_WRONLY | os.O_APPEND)
    except FileNotFoundError as error:
        raise lost from error
    for descriptor in (1, 2):
        os.dup2(log, descriptor)
    os.close(log)


#: The kinds of work: building a variant or making its images again, and training a cell.
_WORK: dict[str, Callable[[Mapping[str, Any]], dict[str, Any]]] = {
    "variant": _make_variant,
    "cell": _run_cell,
}


def follow_parent() -> None:
    """End this child and its children when the parent has ended.

    An orphan would go on writing to a cell whose lease is free. A shell process waits for the end
    of the pipe on standard input. A thread could not end a child that hangs in native code with the
    interpreter's lock, and PR_SET_PDEATHSIG would spare the child's children.
    """
    if os.getpgrp() != os.getpid():
        return  # started by hand: the process group is the shell's
    subprocess.Popen(["/bin/sh", "-c", _WATCHER, "sh", str(os.getpid())])  # noqa: S603


def main(work: str, request: str, answer: str) -> None:
    """Do one piece of work in the child, and write its answer or the reason why it failed."""
    guard_streams()
    faulthandler.enable()
    machine.end_quickly()
    follow_parent()
    machine.offer_to_oom_killer()
    given: dict[str, Any] = {}
    try:
        given = read_struct(Path(request), dict[str, Any])
        result = Answer(_WORK[work](given))
    except WorkError as error:
        result = Answer(error=str(error), outcome=error.outcome)
    except XrgsError as error:
        result = Answer(error=str(error))
    except Exception as error:
        full = isinstance(error, OSError) and unwritable(error)
        gone = "store" in given and Store(given["store"]).is_gone
        if not (full or gone):  # the parent says so
            say(traceback.format_exc(), sys.stderr)
        outcome = UNWRITABLE if full else "failed"
        result = Answer(error=f"{type(error).__name__}: {error}", outcome=outcome)
    try:
        write_json(Path(answer).absolute(), msgspec.to_builtins(result))
    except OSError:
        sys.exit(os.EX_IOERR)  # the parent says so
    if result.outcome == LOCKED:
        sys.exit(os.EX_TEMPFAIL)


if __name__ == "__main__":
    main(*sys.argv[1:])
