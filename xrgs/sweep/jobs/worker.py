"""Work in a process of its own: a kill, an out-of-memory or a segfault ends that work alone.

The parent (`run`) stays without torch; the child is
`python -m xrgs.sweep.jobs.worker JOB REQUEST ANSWER`.
"""

from __future__ import annotations

import errno
import faulthandler
import json
import logging
import os
import signal
import sys
import tempfile
import traceback
from pathlib import Path
from typing import TYPE_CHECKING, Any

from xrgs.errors import XrgsError
from xrgs.runtime.machine import let_openmp_sleep
from xrgs.runtime.streams import ignore_broken_pipe
from xrgs.safeio.atomic import write_json
from xrgs.safeio.records import read_json
from xrgs.sweep.jobs import supervise

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

#: What says that a file system takes no more, whatever the job does.
_UNWRITABLE = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EIO})
_NO_LIMITS = supervise.Limits()


class WorkerError(XrgsError):
    """The child said why it failed, or died without a word."""


class UnwritableError(WorkerError):
    """The child could not write: the disk is full, or read-only, or broken."""


def run(
    job: str,
    request: Mapping[str, Any],
    limits: supervise.Limits = _NO_LIMITS,
    on_poll: Callable[[int], None] = lambda _: None,
) -> dict[str, Any]:
    """Run one job in a child process and return its answer.

    Args:
        job: a name in `_JOBS`.
        request: what it is to do, as plain JSON values.
        limits: the child is ended where it goes beyond.
        on_poll: called while it runs, with the child's number; what it raises ends the child, and
            is raised here.

    Raises:
        UnwritableError: it could not write its files; nothing else is wrong with it.
        WorkerError: the job failed; the message is its reason.
    """
    with tempfile.TemporaryDirectory(prefix="xrgs-") as folder:
        request_file, answer_file = Path(folder) / "request.json", Path(folder) / "answer.json"
        write_json(request_file, dict(request))
        # -P: run from a checkout, the child must import the installed package as its parent does.
        child = [sys.executable, "-P", "-m", "xrgs.sweep.jobs.worker"]
        command = [*child, job, str(request_file), str(answer_file)]
        ended = supervise.run(command, limits, on_poll)
        if ended.reason:
            raise WorkerError(ended.reason)
        if not answer_file.exists() and ended.code == os.EX_IOERR:
            raise UnwritableError(f"it had no room for its answer in {folder}: is the disk full?")
        if not answer_file.exists():
            raise WorkerError(_death(ended.code))
        answer = dict(read_json(answer_file))
    if "error" in answer:
        unwritable = answer.get("errno") in _UNWRITABLE
        raise (UnwritableError if unwritable else WorkerError)(str(answer["error"]))
    return answer


def unwritable(error: OSError) -> bool:
    """Whether an error is the file system's, that nothing more can be written."""
    return error.errno in _UNWRITABLE


def _death(code: int) -> str:
    if code >= 0:
        return f"its process ended with exit code {code} before it answered"
    name = signal.Signals(-code).name
    hint = " (out of memory?)" if -code == signal.SIGKILL else ""
    return f"its process was ended by {name}{hint}"


def _build_variant(request: Mapping[str, Any]) -> dict[str, Any]:
    from xrgs.capture import variant
    from xrgs.config import from_dict
    from xrgs.experiment.store import Store

    conf, store = from_dict(request["conf"]), Store(Path(request["store"]))
    built = variant.build(conf.scene, conf.variant, store.variants, store.scenes)
    return {"variant": built.id}


def _run_cell(request: Mapping[str, Any]) -> dict[str, Any]:
    from xrgs.capture import variant
    from xrgs.config import from_dict
    from xrgs.experiment import cell
    from xrgs.experiment.store import CellFolder

    folder = CellFolder(Path(request["cell"]))
    with (folder.path / "log.txt").open("a", encoding="utf-8") as log:
        # All that the cell, libraries and children print, to the last words. How far it is, it
        # leaves in a file: on a terminal the bars of several cells would run into each other.
        for descriptor in (1, 2):
            os.dup2(log.fileno(), descriptor)
        # A cell that is ended from outside says where it was. To the descriptor, which stays open.
        faulthandler.register(signal.SIGTERM, 2, chain=True)
        logging.basicConfig(format="%(asctime)s %(message)s", level=logging.INFO)
        frozen = variant.load(Path(request["variant"]))
        if frozen.id != frozen.path.name:
            raise variant.CorruptVariant(f"{frozen.path}: this is variant {frozen.id}, renamed")
        cell.run(from_dict(request["conf"]), frozen, folder)
    return {}


_JOBS: dict[str, Callable[[Mapping[str, Any]], dict[str, Any]]] = {
    "variant": _build_variant,
    "cell": _run_cell,
}


def main(job: str, request: str, answer: str) -> None:
    """The child: do the job and write the answer, or what went wrong."""
    faulthandler.enable()
    ignore_broken_pipe()
    supervise.follow_parent()
    supervise.offer_to_oom_killer()
    let_openmp_sleep()
    try:
        result = _JOBS[job](json.loads(Path(request).read_text(encoding="utf-8")))
    except XrgsError as error:
        result = {"error": str(error)}
    except Exception as error:
        traceback.print_exc()
        number = error.errno if isinstance(error, OSError) else None
        result = {"error": f"{type(error).__name__}: {error}", "errno": number}
    try:
        write_json(Path(answer), result)
    except OSError:
        traceback.print_exc()
        sys.exit(os.EX_IOERR)


if __name__ == "__main__":
    main(*sys.argv[1:])
