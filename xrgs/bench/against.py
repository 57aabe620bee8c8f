"""Compares this installation with another one, in one run: `xrgs-bench --against PYTHON`.

Each installation has a process of its own that stays alive (`xrgs.bench.against_worker`, run by its
interpreter) and is asked for one repetition at a time. The two take turns, A B A B, so whatever
slows the machine down for a while slows both down, and the ratio of two neighbouring repetitions
stays true. The medians and the quartiles of these ratios are what is reported.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

import numpy as np

from xrgs.bench import loads
from xrgs.errors import XrgsError
from xrgs.runtime.progress import progress
from xrgs.safeio.untrusted import parse_json

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from xrgs.bench.loads import Load

    #: Milliseconds of each repetition, by side, task and number of threads.
    Durations = dict[tuple[str, str, int], NDArray[np.float64]]

#: The share of high-resolution views among the steps of a mixed-resolution training.
HR_SHARE = 0.3
SIDES = ("this", "other")
RENDER, HR_STEP, LR_STEP, MEAN_STEP = "render", "HR step", "LR step", "mean step"
_WORKER = Path(__file__).with_name("against_worker.py")
_LAST_LINES = 3  # of what a worker that failed wrote


def measure(
    other: str, scene: Load, step: tuple[Load, Load], counts: Sequence[int], repeats: int
) -> dict[str, Any]:
    """Time rendering and training steps in both installations, in turn.

    Args:
        other: Path of the Python executable in whose environment the other xrgs is installed.
        scene: What is rendered forward and backward.
        step: The HR and the LR view that are trained on.
        counts: Numbers of threads.
        repeats: Number of timed repetitions of each task in each installation.

    Returns:
        Under `this` and `other`, the folder of the package and its instruction set; and under
        `rows` what `summarize` returns.

    Raises:
        XrgsError: `other` is no executable file, or a worker fails; the message has the end of what
            it wrote.
    """
    # Not resolved: the executable of a virtual environment is a link, and its place tells Python
    # which environment it belongs to.
    python = str(Path(other).absolute())
    if not (Path(python).is_file() and os.access(python, os.X_OK)):
        raise XrgsError(f"against={other}: must be the Python executable of an environment")
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="xrgs-bench-")))
        files = {}
        for name, load in zip((RENDER, HR_STEP, LR_STEP), (scene, *step), strict=True):
            files[name] = str(folder / f"{name}.npz")
            loads.write(Path(files[name]), load)
        workers = {
            side: stack.enter_context(_Worker(executable, folder / side))
            for side, executable in zip(SIDES, (sys.executable, python), strict=True)
        }
        setup = {"scene": files[RENDER], "views": {key: files[key] for key in (HR_STEP, LR_STEP)}}
        for worker in workers.values():
            worker.send(setup)
        found: dict[str, Any] = {side: worker.answer() for side, worker in workers.items()}
        durations = _alternate(workers, list(files), counts, repeats)
    return found | {"rows": summarize(durations, counts)}


class _Worker:
    """A process that runs one installation; a context manager that ends it.

    Raises:
        XrgsError: The executable is no program, or the process ends or answers something else.
    """

    def __init__(self, python: str, log: Path) -> None:
        self.python = python
        self.log = log
        # The worker must import the package of its own interpreter: -P keeps the folder of the
        # script out of sys.path, and PYTHONPATH could name this package.
        environment = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
        environment.setdefault("OMP_WAIT_POLICY", "passive")  # as in training
        try:
            with log.open("wb") as stderr:
                self.process = subprocess.Popen(  # noqa: S603
                    [python, "-P", str(_WORKER)],
                    cwd=log.parent,
                    env=environment,
                    stdin=subprocess.PIPE,
                    stdout=subprocess.PIPE,
                    stderr=stderr,
                    text=True,
                )
        except OSError as error:
            raise XrgsError(f"against: {python} cannot be run: {error.strerror}") from error

    def __enter__(self) -> _Worker:
        return self

    def __exit__(self, *error: object) -> None:
        self.process.kill()  # it has nothing to lose
        self.process.wait()
        _opened(self.process.stdout).close()
        with suppress(BrokenPipeError):  # of a request that it never read
            _opened(self.process.stdin).close()

    def send(self, request: dict[str, Any]) -> None:
        """Write a request."""
        stream = _opened(self.process.stdin)
        try:
            stream.write(json.dumps(request) + "\n")
            stream.flush()
        except BrokenPipeError:
            raise self._failure() from None

    def answer(self) -> dict[str, Any]:
        """Read the answer to the oldest request that has none."""
        line = _opened(self.process.stdout).readline()
        if not line:
            raise self._failure()
        try:
            answer: dict[str, Any] = parse_json(line.encode())
        except ValueError:
            raise XrgsError(f"against: {self.python} answers {line.strip()!r}, not JSON") from None
        return answer

    def _failure(self) -> XrgsError:
        self.process.wait()
        lines = self.log.read_text("utf-8", errors="replace").strip().splitlines()
        said = " | ".join(lines[-_LAST_LINES:]) or f"ended with {self.process.returncode}"
        return XrgsError(f"against: {self.python} cannot run the benchmark: {said}")


def _opened(stream: IO[str] | None) -> IO[str]:
    assert stream is not None, "both streams are pipes"  # noqa: S101
    return stream


def _alternate(
    workers: dict[str, _Worker], tasks: Sequence[str], counts: Sequence[int], repeats: int
) -> Durations:
    """Run each task in each worker once to warm up, then all of them in turn."""
    cases = [(task, count) for task in tasks for count in counts]
    durations: dict[tuple[str, str, int], list[float]] = {
        (side, *case): [] for side in SIDES for case in cases
    }
    for repeat in progress(range(repeats + 1), "comparing", "repeat", repeats + 1):
        for task, count in cases:
            for side, worker in workers.items():
                worker.send({"task": task, "threads": count})
                ms = worker.answer()["ms"]
                if repeat > 0:
                    durations[side, task, count].append(ms)
    return {case: np.array(values) for case, values in durations.items()}


def summarize(durations: Durations, counts: Sequence[int]) -> list[dict[str, Any]]:
    """Compare the two installations, repetition by repetition.

    Args:
        durations: Milliseconds of each repetition, by side (`SIDES`), task and number of threads.
        counts: Numbers of threads, ascending, the first of them 1.

    Returns:
        A row for each task, the mean step among them, and number of threads: the medians `this_ms`
        and `other_ms`; `times_faster`, the median over the repetitions of the other's time over
        this one's, and its quartiles `times_faster_low` and `times_faster_high`; and
        `this_speedup` and `other_speedup`, the median ratio of the time on one thread to that on
        this row's number.
    """
    durations = dict(durations)
    for side in SIDES:
        for count in counts:
            hr, lr = (durations[side, task, count] for task in (HR_STEP, LR_STEP))
            durations[side, MEAN_STEP, count] = HR_SHARE * hr + (1 - HR_SHARE) * lr
    rows = []
    for task in (RENDER, HR_STEP, LR_STEP, MEAN_STEP):
        for count in counts:
            this, other = (durations[side, task, count] for side in SIDES)
            low, middle, high = np.quantile(other / this, (0.25, 0.5, 0.75))
            row: dict[str, Any] = {"task": task, "threads": count}
            row |= {"this_ms": float(np.median(this)), "other_ms": float(np.median(other))}
            row |= {"times_faster": float(middle)}
            row |= {"times_faster_low": float(low), "times_faster_high": float(high)}
            for side in SIDES:
                ratio = durations[side, task, counts[0]] / durations[side, task, count]
                row[f"{side}_speedup"] = float(np.median(ratio))
            rows.append(row)
    return rows
