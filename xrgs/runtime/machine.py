"""Cores, threads and memory that this process uses."""

from __future__ import annotations

import os
import resource
import sys
from collections.abc import Iterator
from contextlib import contextmanager


def usable_cores() -> int:
    """Count the cores that this process may run on: its CPU affinity, if the system has that."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def peak_rss() -> int:
    """Return the largest resident memory of this process so far, in bytes."""
    unit = 1 if sys.platform == "darwin" else 1024  # of ru_maxrss
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit


def set_passive_openmp_wait() -> None:
    """Make OpenMP's threads sleep between parallel loops; call this before torch is imported.

    A value of OMP_WAIT_POLICY that is already in the environment is kept.
    """
    # torch's threads are OpenMP's. By default they spin for milliseconds after each loop, on cores
    # that the native kernels need then: on two busy cores a step took three times as long.
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")


def set_torch_threads(threads: int) -> int:
    """Set the number of torch's threads, 0 for every usable core; return the number."""
    import torch

    torch.set_num_threads(threads or usable_cores())
    return torch.get_num_threads()


@contextmanager
def single_torch_thread() -> Iterator[int]:
    """Limit torch to one thread during a block; yield the number before and after it."""
    import torch

    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield threads
    finally:
        torch.set_num_threads(threads)
