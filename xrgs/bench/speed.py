"""Measures the training speed of this machine within seconds, to predict the time of a training."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import median

from xrgs.bench.loads import random_load
from xrgs.bench.training import TrainingStep
from xrgs.config import Conf
from xrgs.mixture import variant
from xrgs.runtime.machine import set_torch_threads
from xrgs.splat.backend import resolve_backend
from xrgs.training import dataset
from xrgs.training.loop import train

#: Size of the load's view, px, and number of Gaussians: half a Gaussian per pixel, as after
#: training.
_SIZE, _GAUSSIANS = (252, 189), 24_000
#: Time of the measurement, seconds, and least number of steps.
_SECONDS, _LEAST_STEPS = 2.0, 3
#: Steps of a trial. All schedules are scaled to it, so that Gaussians grow as in a long run.
_TRIAL = 200
#: Time of densification over that of the other parts of a step, in a run of several thousand steps
#: (our choice; 0.13 on monstree, 7,500 steps). The ratio in a trial is higher and not used, since a
#: trial has the same number of refinements in fewer steps.
_DENSIFICATION = 0.15


@dataclass(frozen=True)
class Trial:
    """The measured times of a training."""

    start_s: float
    """Time before the first step, of a dense start, seconds."""
    step_s: float
    """Time of a step, seconds."""


def trial(conf: Conf, folder: Path) -> Trial:
    """Time 200 training steps on a variant; their result is discarded."""
    set_torch_threads(conf.threads)
    data = dataset.load(variant.load(folder), conf.train.views)
    short = replace(conf, train=replace(conf.train, steps=_TRIAL, evaluate_every=0))
    seconds = train(data, short).stage_seconds
    of_steps = sum(seconds[stage] for stage in ("forward", "backward", "optimizer"))
    return Trial(seconds.get("start", 0.0), (1 + _DENSIFICATION) * of_steps / _TRIAL)


def seconds_per_unit(threads: int, backend: str = "auto") -> float:
    """Measure the time of a training step divided by the number of pixels plus Gaussians, seconds.

    `xrgs.sweep.estimate` uses the same unit. The result is the median of a few steps on random
    Gaussians.
    """
    load = random_load(_GAUSSIANS, *_SIZE, seed=0)
    step = TrainingStep(load, resolve_backend(backend), threads)
    step.run_step()  # the first step allocates memory
    times: list[float] = []
    while sum(times) < _SECONDS or len(times) < _LEAST_STEPS:
        start = time.perf_counter()
        step.run_step()
        times.append(time.perf_counter() - start)
    return median(times) / (_SIZE[0] * _SIZE[1] + _GAUSSIANS)
