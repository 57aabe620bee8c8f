"""Times tasks in turn, so that their ratios are valid also on a machine with other work."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any, TypeVar

import torch

Row = dict[str, Any]  # column -> value
_Key = TypeVar("_Key")


def time_interleaved(
    tasks: Mapping[_Key, Callable[[], object]], repeats: int
) -> dict[_Key, list[float]]:
    """Run each task once to warm up, then all tasks in turn (A B A B ...).

    Returns:
        Key -> duration of each run, ms.
    """
    for task in tasks.values():
        task()
    durations: dict[_Key, list[float]] = {key: [] for key in tasks}
    # In turn, so that other work on the machine slows down all tasks alike.
    for _ in range(repeats):
        for key, task in tasks.items():
            start = time.perf_counter()
            task()
            durations[key].append(1e3 * (time.perf_counter() - start))
    return durations


@contextmanager
def use_threads(count: int) -> Iterator[None]:
    """Set the number of threads of torch and of the native kernels for a `with` block."""
    before = torch.get_num_threads()
    torch.set_num_threads(count)  # the native kernels read torch's number
    try:
        yield
    finally:
        torch.set_num_threads(before)
