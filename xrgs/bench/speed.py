"""Measures how quickly this machine trains, in seconds: enough to say how long a training takes."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from statistics import median
from typing import TYPE_CHECKING

from xrgs.bench.loads import random_load
from xrgs.bench.training import TrainingStep
from xrgs.mixture import variant
from xrgs.runtime.machine import set_torch_threads
from xrgs.splat.backend import resolve_backend
from xrgs.training import dataset
from xrgs.training.loop import train

if TYPE_CHECKING:
    from pathlib import Path

    from xrgs.config import Conf

#: The view of the load, px, and its Gaussians: half a Gaussian for each pixel, as after training.
_SIZE, _GAUSSIANS = (252, 189), 24_000
#: Seconds that are measured, and the fewest steps.
_SECONDS, _LEAST_STEPS = 2.0, 3
#: Steps of a trial. All schedules shrink to it, so that as many Gaussians grow as in a long run.
_TRIAL = 200
#: Densification takes this share of the other parts of a step in a run of some thousand steps (our
#: choice; 0.13 on monstree, 7,500 steps). In a trial it takes more, since it refines as often.
_DENSIFICATION = 0.15


@dataclass(frozen=True)
class Trial:
    """How long a training takes."""

    start_s: float
    """Seconds before the first step: those of a dense start."""
    step_s: float
    """Seconds of a step."""


def trial(conf: Conf, folder: Path) -> Trial:
    """Train on a variant for 200 steps, which are thrown away, and measure them.

    Args:
        conf: The config of the training whose length is not known yet.
        folder: The variant's folder.
    """
    set_torch_threads(conf.threads)
    data = dataset.load(variant.load(folder), conf.train.views)
    short = replace(conf, train=replace(conf.train, steps=_TRIAL, evaluate_every=0))
    seconds = train(data, short).stage_seconds
    of_steps = sum(seconds[stage] for stage in ("forward", "backward", "optimizer"))
    return Trial(seconds.get("start", 0.0), (1 + _DENSIFICATION) * of_steps / _TRIAL)


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
