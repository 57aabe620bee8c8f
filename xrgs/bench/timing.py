"""Times tasks in turn, so that their ratios are valid also on a machine with other work."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Any, TypeVar

from xrgs.runtime.machine import torch_threads

Row = dict[str, Any]  # column -> value
_Key = TypeVar("_Key")


def time_interleaved(
    tasks: Mapping[_Key, tuple[int, Callable[[], object]]], repeats: int
) -> dict[_Key, list[float]]:
    """Run each task once to warm up, then all tasks in turn (A B A B ...).

    Args:
        tasks: Key -> number of threads, and function.
        repeats: Number of timed runs of each.

    Returns:
        Key -> duration of each run, ms.
    """
    durations: dict[_Key, list[float]] = {key: [] for key in tasks}
    # In turn, so that other work on the machine slows down all tasks alike.
    for _ in range(1 + repeats):
        for key, (threads, task) in tasks.items():
            with torch_threads(threads):
                start = time.perf_counter()
                task()
                durations[key].append(1e3 * (time.perf_counter() - start))
    return {key: times[1:] for key, times in durations.items()}
