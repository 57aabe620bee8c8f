"""Measures how quickly this machine trains, in seconds: enough to say how long a training takes."""

from __future__ import annotations

import time
from statistics import median

from xrgs.bench.loads import random_load
from xrgs.bench.training import TrainingStep
from xrgs.splat.backend import resolve_backend

#: The view of the load, px, and its Gaussians: half a Gaussian for each pixel, as after training.
_SIZE, _GAUSSIANS = (252, 189), 24_000
#: Seconds that are measured, and the fewest steps.
_SECONDS, _LEAST_STEPS = 2.0, 3


def seconds_per_unit(threads: int, backend: str = "auto") -> float:
    """Measure training steps: seconds a step, for each rendered pixel and each Gaussian.

    Both count alike, as in `xrgs.sweep.estimate`. The median of a few steps on random Gaussians.

    Args:
        threads: Number of threads.
        backend: `splat.backend`.
    """
    load = random_load(_GAUSSIANS, *_SIZE, seed=0)
    step = TrainingStep(load, resolve_backend(backend), threads)
    step.run_step()  # the first one allocates
    times: list[float] = []
    while sum(times) < _SECONDS or len(times) < _LEAST_STEPS:
        start = time.perf_counter()
        step.run_step()
        times.append(time.perf_counter() - start)
    return median(times) / (_SIZE[0] * _SIZE[1] + _GAUSSIANS)
