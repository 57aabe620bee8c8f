"""Times alternatives against one another on a machine that does other work too."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass

import torch


@dataclass(frozen=True)
class Timings:
    """The durations of one task."""

    milliseconds: tuple[float, ...]
    """Duration of each run, in the order of the runs."""

    @property
    def minimum(self) -> float:
        """The shortest run in ms: the duration when nothing else disturbs the task."""
        return min(self.milliseconds)

    @property
    def median(self) -> float:
        """The median run in ms."""
        return statistics.median(self.milliseconds)


def time_interleaved(tasks: Mapping[str, Callable[[], object]], repeats: int) -> dict[str, Timings]:
    """Run each task once to warm up, then all of them in turn, A B A B, `repeats` times.

    Whatever slows the machine down for a while then slows all tasks down, so that the ratios of
    their durations stay true.

    Args:
        tasks: The tasks by name.
        repeats: Number of timed runs of each task.

    Returns:
        The durations of each task, by its name.
    """
    for task in tasks.values():
        task()
    durations: dict[str, list[float]] = {name: [] for name in tasks}
    for _ in range(repeats):
        for name, task in tasks.items():
            start = time.perf_counter()
            task()
            durations[name].append(1e3 * (time.perf_counter() - start))
    return {name: Timings(tuple(values)) for name, values in durations.items()}


@contextmanager
def use_threads(count: int) -> Iterator[None]:
    """Set the number of threads of torch, and with it of the native kernels, for a `with` block.

    Args:
        count: Number of threads.
    """
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)
