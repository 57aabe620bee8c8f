"""Compares the speed of this installation of xrgs with another: `xrgs-bench --against PYTHON`.

Each installation runs its `xrgs.bench.against_worker` in a process, which runs one repetition for
each request. The two processes take turns, so that other work on the machine slows both down, and
the ratio of two consecutive repetitions stays valid. Both are started anew after a few repetitions.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from xrgs.bench import loads
from xrgs.errors import XrgsError
from xrgs.runtime.progress import progress

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from numpy.typing import NDArray

    from xrgs.bench.loads import Load
    from xrgs.bench.timing import Row

    #: (side, task, number of threads) -> time of each repetition, ms.
    Durations = Mapping[tuple[str, str, int], NDArray[np.float64]]

HR_SHARE = 0.3  # fraction of HR steps in a mixed-resolution training
SIDES = ("this", "other")
RENDER, HR_STEP, LR_STEP, MEAN_STEP = "render", "HR step", "LR step", "mean step"
_LAST_LINES = 3  # of a failed worker's output that the error shows
#: Repetitions of one pair of processes. A process is faster or slower for as long as it lives,
#: by where its memory lies: an installation took 0.72 to 1.25 times as long as itself in one pair.
_PAIR_REPEATS = 5


def measure(
    python: Path, scene: Load, step: tuple[Load, Load], counts: Sequence[int], repeats: int
) -> dict[str, Any]:
    """Time rendering and training steps in both installations, in turn.

    Args:
        python: The Python executable of the environment with the other xrgs.
        scene: The load to render forward and backward.
        step: The HR and the LR view of the training steps.
        counts: Numbers of threads; the first is 1.
        repeats: Number of timed repetitions of each task in each installation.

    Returns:
        `this` and `other`: folder of the package, and its instruction set; `scene` and `step`:
        sizes of the loads; `rows`: the result of `summarize`.

    Raises:
        XrgsError: `python` is not an executable file, or a worker fails.
    """
    # Not resolved: the Python of a virtual environment is a link, and finds the environment by its
    # own path.
    other = python.absolute()
    if not (other.is_file() and os.access(other, os.X_OK)):
        raise XrgsError(f"--against {python}: must be the Python executable of an environment")
    with tempfile.TemporaryDirectory(prefix="xrgs-bench-") as name:
        folder = Path(name)
        files = {}
        for task, load in zip((RENDER, HR_STEP, LR_STEP), (scene, *step), strict=True):
            files[task] = str(folder / f"{task}.npz")
            loads.write(Path(files[task]), load)
        setup = {"scene": files[RENDER], "views": {key: files[key] for key in (HR_STEP, LR_STEP)}}
        executables = dict(zip(SIDES, (sys.executable, str(other)), strict=True))
        cases = [(task, count) for task in files for count in counts]
        durations: dict[tuple[str, str, int], list[float]] = {
            (side, *case): [] for side in SIDES for case in cases
        }
        answers: dict[str, Any] = {}
        for done in progress(range(0, repeats, _PAIR_REPEATS), "comparing", "pair"):
            order = SIDES if done // _PAIR_REPEATS % 2 == 0 else SIDES[::-1]
            with ExitStack() as pair:
                workers = {
                    side: pair.enter_context(_Worker(executables[side], folder / side))
                    for side in order
                }
                for worker in workers.values():
                    worker.send(setup)
                answers |= {side: worker.answer() for side, worker in workers.items()}
                for case, ms in _take_turns(workers, cases, min(_PAIR_REPEATS, repeats - done)):
                    durations[case].append(ms)
    timed = {case: np.array(values) for case, values in durations.items()}
    sizes = {"scene": scene.sizes, "step": step[0].sizes}
    return answers | sizes | {"rows": summarize(timed, counts)}


class _Worker:
    """The process of an installation; leaving the `with` block ends it."""

    def __init__(self, python: str, log: Path) -> None:
        self.python, self.log = python, log
        environment = dict(os.environ)
        if python != sys.executable:
            environment.pop("PYTHONPATH", None)  # may contain this installation
        environment.setdefault("OMP_WAIT_POLICY", "passive")  # as in training
        try:
            with log.open("wb") as stderr:
                self.process = subprocess.Popen(  # noqa: S603
                    # -P: does not import a checkout in the current folder.
                    [python, "-P", "-m", "xrgs.bench.against_worker"],
                    cwd=log.parent,
                    env=environment,
                    stdin=subprocess.PIPE,
                    stdout=subprocess.PIPE,
                    stderr=stderr,
                    text=True,
                )
        except OSError as error:
            raise XrgsError(f"against: {python} cannot be run: {error.strerror}") from error
        assert self.process.stdin is not None  # noqa: S101
        assert self.process.stdout is not None  # noqa: S101
        self.requests, self.answers = self.process.stdin, self.process.stdout

    def __enter__(self) -> _Worker:
        return self

    def __exit__(self, *error: object) -> None:
        self.process.kill()  # it has no data to save
        self.process.wait()
        self.answers.close()
        with suppress(BrokenPipeError):  # from an unread request
            self.requests.close()

    def send(self, request: Mapping[str, Any]) -> None:
        """Send a request."""
        try:
            self.requests.write(json.dumps(request) + "\n")
            self.requests.flush()
        except BrokenPipeError:
            raise self._failure() from None

    def answer(self) -> dict[str, Any]:
        """Read the answer to the oldest unanswered request."""
        line = self.answers.readline()
        if not line:
            raise self._failure()
        try:
            answer: dict[str, Any] = json.loads(line)
        except ValueError:
            raise XrgsError(f"against: {self.python} answers {line.strip()!r}, not JSON") from None
        return answer

    def _failure(self) -> XrgsError:
        self.process.wait()
        lines = self.log.read_text("utf-8", errors="replace").strip().splitlines()
        output = " | ".join(lines[-_LAST_LINES:]) or f"ended with {self.process.returncode}"
        return XrgsError(f"against: {self.python} cannot run the benchmark: {output}")


def _take_turns(
    workers: Mapping[str, _Worker], cases: Sequence[tuple[str, int]], repeats: int
) -> Iterator[tuple[tuple[str, str, int], float]]:
    """Run each case in each worker once to warm up, then yield the times of repetitions in turn."""
    for repeat in range(repeats + 1):
        for task, count in cases:
            for side, worker in workers.items():
                worker.send({"task": task, "threads": count})
                ms = worker.answer()["ms"]
                if repeat > 0:
                    yield (side, task, count), ms


def summarize(durations: Durations, counts: Sequence[int]) -> list[Row]:
    """Compare the two installations, repetition by repetition.

    Args:
        durations: (side, one of `SIDES`; task; number of threads) -> time of each repetition, ms.
        counts: Numbers of threads, ascending; the first is 1.

    Returns:
        A row for each task (including the mean step) and number of threads, with the columns

        - `this_ms`, `other_ms`: median times;
        - `times_faster`: median ratio of the other's time over this one's, with the quartiles
          `times_faster_low` and `times_faster_high`;
        - `this_speedup`, `other_speedup`: median speed-ups over one thread.
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
            row: Row = {
                "task": task,
                "threads": count,
                "this_ms": float(np.median(this)),
                "other_ms": float(np.median(other)),
                "times_faster": float(middle),
                "times_faster_low": float(low),
                "times_faster_high": float(high),
            }
            for side in SIDES:
                ratio = durations[side, task, 1] / durations[side, task, count]
                row[f"{side}_speedup"] = float(np.median(ratio))
            rows.append(row)
    return rows
