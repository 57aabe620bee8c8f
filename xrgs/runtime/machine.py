"""What of this machine a process may use."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager


def usable_cores() -> int:
    """Cores that this process may run on, which can be fewer than the machine has."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def let_openmp_sleep() -> None:
    """Have OpenMP's threads sleep between their loops. To be called before torch is imported.

    torch's own threads are OpenMP's, and spin for milliseconds after each loop in case there is
    another, on the cores that the native kernels' threads want meanwhile: on two busy cores a
    training step took three times as long. Who has set OMP_WAIT_POLICY is left alone.
    """
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")


@contextmanager
def one_thread() -> Iterator[int]:
    """Have torch work with one thread for a while.

    Yields:
        How many it had, and has again afterwards.
    """
    import torch

    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield threads
    finally:
        torch.set_num_threads(threads)
