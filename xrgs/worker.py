"""Work in a process of its own: a kill, an out-of-memory or a segfault ends that work alone.

The parent (`run`) stays without torch; the child is `python -m xrgs.worker JOB REQUEST ANSWER`.
"""

from __future__ import annotations

import faulthandler
import json
import logging
import signal
import subprocess
import sys
import tempfile
import traceback
from pathlib import Path
from typing import TYPE_CHECKING, Any

from xrgs.errors import XrgsError
from xrgs.files import write_json
from xrgs.machine import let_openmp_sleep
from xrgs.store import read_json

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping


class WorkerError(XrgsError):
    """The child said why it failed, or died without a word."""


def run(job: str, request: Mapping[str, Any]) -> dict[str, Any]:
    """Run one job in a child process and return its answer.

    Args:
        job: a name in `_JOBS`.
        request: what it is to do, as plain JSON values.

    Raises:
        WorkerError: the job failed; the message is its reason.
    """
    with tempfile.TemporaryDirectory(prefix="xrgs-") as folder:
        request_file, answer_file = Path(folder) / "request.json", Path(folder) / "answer.json"
        write_json(request_file, dict(request))
        # -P: run from a checkout, the child must import the installed package as its parent does.
        child = [sys.executable, "-P", "-m", "xrgs.worker"]
        command = [*child, job, str(request_file), str(answer_file)]
        code = subprocess.run(command, check=False).returncode  # noqa: S603
        if not answer_file.exists():
            raise WorkerError(_death(code))
        answer = dict(read_json(answer_file))
    if "error" in answer:
        raise WorkerError(str(answer["error"]))
    return answer


def _death(code: int) -> str:
    if code >= 0:
        return f"its process ended with exit code {code} before it answered"
    name = signal.Signals(-code).name
    hint = " (out of memory?)" if -code == signal.SIGKILL else ""
    return f"its process was ended by {name}{hint}"


def _build_variant(request: Mapping[str, Any]) -> dict[str, Any]:
    from xrgs import variant
    from xrgs.config import from_dict
    from xrgs.store import Store

    conf, store = from_dict(request["conf"]), Store(Path(request["store"]))
    built = variant.build(conf.scene, conf.variant, store.variants, store.scenes)
    return {"variant": built.id}


def _run_cell(request: Mapping[str, Any]) -> dict[str, Any]:
    from xrgs import cell, variant
    from xrgs.config import from_dict
    from xrgs.store import CellFolder

    folder = CellFolder(Path(request["cell"]))
    with (folder.path / "log.txt").open("a", encoding="utf-8") as log:
        faulthandler.enable(log)
        logging.basicConfig(
            format="%(asctime)s %(message)s",
            level=logging.INFO,
            handlers=[logging.StreamHandler(log), logging.StreamHandler()],
        )
        cell.run(from_dict(request["conf"]), variant.load(Path(request["variant"])), folder)
        faulthandler.disable()
    return {}


_JOBS: dict[str, Callable[[Mapping[str, Any]], dict[str, Any]]] = {
    "variant": _build_variant,
    "cell": _run_cell,
}


def main(job: str, request: str, answer: str) -> None:
    """The child: do the job and write the answer, or what went wrong."""
    faulthandler.enable()
    let_openmp_sleep()
    try:
        result = _JOBS[job](json.loads(Path(request).read_text(encoding="utf-8")))
    except XrgsError as error:
        result = {"error": str(error)}
    except Exception as error:
        traceback.print_exc()
        result = {"error": f"{type(error).__name__}: {error}"}
    write_json(Path(answer), result)


if __name__ == "__main__":
    main(*sys.argv[1:])
