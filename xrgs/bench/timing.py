"""Timing things against one another on a machine that does other work too."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass

import torch


@dataclass(frozen=True)
class Times:
    """Milliseconds that something took, each time it ran."""

    all: tuple[float, ...]

    @property
    def least(self) -> float:
        """What it takes when nothing disturbs it."""
        return min(self.all)

    @property
    def median(self) -> float:
        """What it took mostly."""
        return statistics.median(self.all)


def alternate(things: Mapping[str, Callable[[], object]], repeats: int) -> dict[str, Times]:
    """Run each thing once to warm up, then all in turn, A B A B, `repeats` times.

    What slows the machine for a while so slows all of them, and their ratios stay true.
    """
    for thing in things.values():
        thing()
    times: dict[str, list[float]] = {name: [] for name in things}
    for _ in range(repeats):
        for name, thing in things.items():
            start = time.perf_counter()
            thing()
            times[name].append(1e3 * (time.perf_counter() - start))
    return {name: Times(tuple(values)) for name, values in times.items()}


@contextmanager
def threads(count: int) -> Iterator[None]:
    """Let torch, and with it the native kernels, use this many threads for a while."""
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)
