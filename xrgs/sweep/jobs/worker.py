"""Does one piece of work in a child process: a kill or a segfault ends that work alone.

The parent calls `run_in_child` and never imports torch. The child runs
`python -m xrgs.sweep.jobs.worker JOB REQUEST ANSWER`: the name of the work, the file of its
arguments, and the file for its answer.
"""

from __future__ import annotations

import errno
import faulthandler
import logging
import os
import signal
import sys
import tempfile
import traceback
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import msgspec

from xrgs.errors import XrgsError
from xrgs.runtime import processes
from xrgs.runtime.machine import set_huge_pages, set_portable_blas
from xrgs.runtime.signals import StopRequest, StopSignal, end_by_sigterm
from xrgs.runtime.streams import guard_streams, log_to_stderr, say
from xrgs.safeio.atomic import write_json
from xrgs.safeio.records import read_struct
from xrgs.store.cell_folder import LOG
from xrgs.sweep.jobs import supervise

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from xrgs.store.cell_folder import CellFolder

#: The message when the store can't be written any more.
NOTHING_LOST = (
    "Finished cells are kept: when there is room to write, run the same command again to continue."
)
#: Errors of a file system that takes no more writes.
_UNWRITABLE = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EIO})
#: Signals that ask a process to end: `scancel` and a cluster's time limits send them, and `kill`.
_ASK_TO_END = frozenset(
    {signal.SIGHUP, signal.SIGINT, signal.SIGTERM, signal.SIGUSR1, signal.SIGUSR2}
)
_NO_LIMITS = supervise.Limits()


class _LostError(Exception):
    """Another attempt at the cell has begun before this one did."""


class Answer(msgspec.Struct, frozen=True):
    """The child's answer when its work has ended."""

    result: dict[str, Any] = {}
    """The result of the work, as plain JSON values."""
    error: str | None = None
    """Why the work failed."""
    errno: int | None = None
    lost: bool = False
    """Whether another attempt at the cell has begun."""


class WorkerError(XrgsError):
    """The work failed in the child, or the child died before it answered."""


class AttemptLostError(WorkerError):
    """Another process has taken the cell over before the child began."""


class InterruptedWorkError(WorkerError):
    """A signal asked the child to end; its work is not known to be faulty."""


class UnwritableError(WorkerError):
    """The child could not write its files: the disk is full, read-only or broken."""


def run_in_child(
    job: str,
    request: Mapping[str, Any],
    limits: supervise.Limits = _NO_LIMITS,
    on_poll: Callable[[int], None] = lambda _: None,
    environment: Mapping[str, str] = MappingProxyType({}),
) -> dict[str, Any]:
    """Do one piece of work in a child process and return its answer.

    Args:
        job: `variant` to build a variant, `restore` to make the images of a trimmed one again, or
            `cell` to train a cell.
        request: The arguments of the work, as plain JSON values.
        limits: The child is ended when it exceeds them.
        on_poll: Called repeatedly while the child runs, with its process id. An exception that it
            raises ends the child and is raised here.
        environment: Variables that the child has besides those of this process.

    Returns:
        The answer of the work, as plain JSON values.

    Raises:
        AttemptLostError: Another attempt at the cell has begun.
        InterruptedWorkError: A signal asked the child to end.
        UnwritableError: The child could not write its files.
        WorkerError: The work failed; the message is the reason.
    """
    set_portable_blas()  # before the child loads it
    set_huge_pages()  # before the child allocates anything
    try:
        temporary = tempfile.TemporaryDirectory(prefix="xrgs-")
    except FileNotFoundError as error:  # /tmp can't be written, nor any other usual place
        raise UnwritableError(f"{error.strerror}: set TMPDIR to a folder for them") from error
    with temporary as name:
        files = Path(name)
        request_file, answer_file = files / "request.json", files / "answer.json"
        write_json(request_file, dict(request))
        # -P keeps the working folder off sys.path: the child imports the package its parent did.
        child = [sys.executable, "-P", "-m", "xrgs.sweep.jobs.worker"]
        command = [*child, job, str(request_file), str(answer_file)]
        ended = supervise.run_supervised(command, limits, on_poll, environment)
        if ended.reason:
            raise WorkerError(ended.reason)
        if not answer_file.exists() and ended.code == os.EX_IOERR:
            raise UnwritableError(f"it could not write its answer to {name}: is the disk full?")
        if not answer_file.exists():
            raise _death(ended.code)
        answer = read_struct(answer_file, Answer)
    if answer.error is not None:
        raise _kind(answer)(answer.error)
    return answer.result


def _kind(answer: Answer) -> type[WorkerError]:
    if answer.lost:
        return AttemptLostError
    return UnwritableError if answer.errno in _UNWRITABLE else WorkerError


def cell_request(variant: Path, cell: CellFolder) -> dict[str, Any]:
    """Return the request to train a cell, after `begin_attempt` has put its folder in place."""
    paths = {"variant": str(variant.absolute()), "cell": str(cell.path.absolute())}
    return {**paths, "id": cell.id, "inode": cell.path.stat().st_ino}


def unwritable(error: OSError) -> bool:
    """Return whether an error says that a file system takes no more writes."""
    return error.errno in _UNWRITABLE


def _death(code: int) -> WorkerError:
    if code >= 0:
        return WorkerError(f"its process ended with exit code {code} before it answered")
    number = signal.Signals(-code)
    hint = " (out of memory?)" if number == signal.SIGKILL else ""
    kind = InterruptedWorkError if number in _ASK_TO_END else WorkerError
    return kind(f"its process was ended by {number.name}{hint}")


def _build_variant(request: Mapping[str, Any]) -> dict[str, Any]:
    from xrgs.composing import from_dict
    from xrgs.mixture import variant
    from xrgs.store.store import Store

    log_to_stderr()
    conf, store = from_dict(request["conf"]), Store(Path(request["store"]))
    built = variant.build(conf.scene, conf.variant, store.variants, store.scenes)
    return {"variant": built.id}


def _restore_variant(request: Mapping[str, Any]) -> dict[str, Any]:
    from xrgs.composing import from_dict
    from xrgs.store.store import Store
    from xrgs.store.trimming import restore_variant

    log_to_stderr()
    conf, store = from_dict(request["conf"]), Store(Path(request["store"]))
    restore_variant(store.variants, request["variant"], conf.scene, conf.variant, store.scenes)
    return {}


def _run_cell(request: Mapping[str, Any]) -> dict[str, Any]:
    _enter_folder(Path(request["cell"]), request["inode"])
    from xrgs.mixture import variant
    from xrgs.store import cell
    from xrgs.store.cell_folder import CellFolder

    stop = StopRequest()
    stop.watch()
    faulthandler.register(supervise.STACK_SIGNAL, 2)
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
        _LostError: Another folder has the name already, or none has.
    """
    lost = _LostError(f"{folder}: another attempt at the cell has begun")
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


def _store_is_gone(request: Mapping[str, Any]) -> bool:
    from xrgs.store.store import Store

    return "store" in request and Store(Path(request["store"])).is_gone


_JOBS: dict[str, Callable[[Mapping[str, Any]], dict[str, Any]]] = {
    "variant": _build_variant,
    "restore": _restore_variant,
    "cell": _run_cell,
}


def main(job: str, request: str, answer: str) -> None:
    """Do one piece of work in the child, and write its answer or the reason why it failed.

    Args:
        job: `variant`, `restore` or `cell`.
        request: JSON file with the arguments.
        answer: File for the answer.
    """
    guard_streams()
    faulthandler.enable()
    supervise.follow_parent()
    processes.offer_to_oom_killer()
    given: dict[str, Any] = {}
    try:
        given = read_struct(Path(request), dict[str, Any])
        result = Answer(_JOBS[job](given))
    except _LostError as error:
        result = Answer(error=str(error), lost=True)
    except XrgsError as error:
        result = Answer(error=str(error))
    except Exception as error:
        if not _store_is_gone(given):  # the parent says so
            say(traceback.format_exc(), sys.stderr)
        number = error.errno if isinstance(error, OSError) else None
        result = Answer(error=f"{type(error).__name__}: {error}", errno=number)
    try:
        write_json(Path(answer).absolute(), msgspec.to_builtins(result))
    except OSError:
        say(traceback.format_exc(), sys.stderr)
        sys.exit(os.EX_IOERR)
    if result.lost:
        sys.exit(os.EX_TEMPFAIL)


if __name__ == "__main__":
    main(*sys.argv[1:])
