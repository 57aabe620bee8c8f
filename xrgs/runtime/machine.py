"""Cores, threads and memory that this process uses."""

from __future__ import annotations

import os
import resource
import sys
from collections.abc import Iterator
from contextlib import contextmanager


def usable_cores() -> int:
    """Count the cores that this process may run on.

    Returns:
        The size of the process's CPU affinity, which can be smaller than the machine; the number
        of cores of the machine on systems without affinity.
    """
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def peak_rss() -> int:
    """Return the largest resident memory of this process so far, in bytes."""
    unit = 1 if sys.platform == "darwin" else 1024  # of ru_maxrss
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit


def set_passive_openmp_wait() -> None:
    """Make OpenMP's threads sleep between parallel loops; call this before torch is imported.

    torch's threads are OpenMP's. By default they spin for milliseconds after each loop, in case
    another one follows, on cores that the threads of the native kernels need in that time: on two
    busy cores a training step took three times as long. A value of OMP_WAIT_POLICY that is already
    in the environment is kept.
    """
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")


def set_torch_threads(threads: int) -> int:
    """Set the number of torch's threads.

    Args:
        threads: The number of threads; 0 for every core that this process may use.

    Returns:
        The number that torch has now.
    """
    import torch

    torch.set_num_threads(threads or usable_cores())
    return torch.get_num_threads()


@contextmanager
def single_torch_thread() -> Iterator[int]:
    """Limit torch to one thread for the length of a block.

    Yields:
        The number of threads that torch had before, and has again afterwards.
    """
    import torch

    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield threads
    finally:
        torch.set_num_threads(threads)
