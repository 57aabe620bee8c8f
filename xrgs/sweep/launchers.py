"""Says how many cells each of Hydra's launchers runs at once, and with how many cores."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from omegaconf import DictConfig, OmegaConf

from xrgs.errors import XrgsError


@dataclass(frozen=True)
class Capacity:
    """How many jobs a launcher runs, and with how many cores."""

    at_once: int | None = None
    """Jobs that run at the same time on this machine; None if the launcher decides."""
    cores: int = 0
    """Cores of a job. With 0, the jobs that run at the same time share the cores of this machine;
    where the launcher decides how many run, a job takes every core that it finds."""
    batch: int | None = None
    """Jobs that may be given to the launcher at once; None for any number."""
    settings: Mapping[str, Any] = field(default_factory=dict)
    """Settings to change in `hydra.launcher`, by their keys there."""

    def threads(self, jobs: int, machine: int) -> int:
        """Return the threads of each job of a batch; 0 for every core that the job finds.

        `machine` is the number of cores of this machine.
        """
        if self.cores or self.at_once is None:
            return self.cores
        return max(1, machine // min(self.at_once, jobs))


def _basic(_: DictConfig, threads: int, _machine: int) -> Capacity:
    return Capacity(at_once=1, cores=threads)


def _joblib(launcher: DictConfig, threads: int, machine: int) -> Capacity:
    jobs = int(launcher["n_jobs"])
    if jobs == 0:
        raise XrgsError("hydra.launcher.n_jobs=0: give the number of cells to train at once")
    if jobs < 0:  # joblib's -1 means one job per core, -2 one fewer
        jobs = max(1, (machine + 1 + jobs) // max(1, threads))
    # Cells that turn out to be done end at once. From such short jobs joblib would learn to hand
    # several jobs to a worker in one batch, which then run one after another.
    return Capacity(jobs, threads, settings={"n_jobs": jobs, "batch_size": 1})


def _submitit_local(launcher: DictConfig, threads: int, machine: int) -> Capacity:
    cores = launcher["cpus_per_task"] or threads
    jobs = max(1, machine // max(1, cores))
    return Capacity(jobs, cores, batch=jobs)  # submitit starts every job of a batch at once


def _submitit_slurm(launcher: DictConfig, threads: int, _machine: int) -> Capacity:
    cores = launcher["cpus_per_task"] or threads or 1
    return Capacity(cores=cores, settings={"cpus_per_task": cores})


def _ray(launcher: DictConfig, threads: int, _machine: int) -> Capacity:
    cores = max(1, int(launcher["ray"]["remote"].get("num_cpus", threads or 1)))
    settings: dict[str, Any] = {"ray.remote.num_cpus": cores}
    if launcher["ray"]["init"].get("address") or os.environ.get("RAY_ADDRESS"):
        # The launcher would fill this in, and Ray refuses it for a cluster that runs already.
        settings["ray.init.object_store_memory"] = None
    return Capacity(cores=cores, settings=settings)


#: Class of a launcher -> function that returns its capacity. The arguments are `hydra.launcher`,
#: the threads that a cell asks for (0 for no preference) and the cores of this machine. Another
#: launcher takes one function and one line.
CAPACITIES: dict[str, Callable[[DictConfig, int, int], Capacity]] = {
    "BasicLauncher": _basic,
    "JoblibLauncher": _joblib,
    "LocalLauncher": _submitit_local,
    "SlurmLauncher": _submitit_slurm,
    "RayLauncher": _ray,
}


def one_cell_a_gpu(launcher: DictConfig, allowed: Capacity, count: int) -> Capacity:
    """Return a capacity for cells that each take a GPU (`splat.backend=gsplat`).

    SLURM and Ray are asked for a GPU a job, unless the launcher's settings ask for some already.
    Other launchers run no more jobs at once than this machine has GPUs, whose `count` is given; a
    job takes a free one (`xrgs.sweep.job`). A launcher that is not in `CAPACITIES` decides by
    itself.
    """
    settings = dict(allowed.settings)
    kind = str(launcher["_target_"]).rpartition(".")[2]
    if kind == "SlurmLauncher":
        if not any(launcher.get(key) for key in ("gres", "gpus_per_node", "gpus_per_task")):
            settings["gres"] = "gpu:1"
    elif kind == "RayLauncher":
        settings["ray.remote.num_gpus"] = launcher["ray"]["remote"].get("num_gpus") or 1
    if allowed.at_once is None:
        return replace(allowed, settings=settings)
    if count == 0:
        raise XrgsError(
            "splat.backend=gsplat: this machine has no GPU: torch sees none, or"
            " CUDA_VISIBLE_DEVICES hides them"
        )
    at_once = min(allowed.at_once, count)
    if "n_jobs" in settings:
        settings["n_jobs"] = at_once
    batch = None if allowed.batch is None else at_once
    return replace(allowed, at_once=at_once, batch=batch, settings=settings)


def capacity(launcher: DictConfig, threads: int, machine: int) -> Capacity:
    """Return how many jobs a launcher runs at once, and with how many cores, see `CAPACITIES`.

    A launcher that is not there decides by itself.
    """
    capacity_of = CAPACITIES.get(str(launcher["_target_"]).rpartition(".")[2])
    return capacity_of(launcher, threads, machine) if capacity_of else Capacity(cores=threads)


def check(config: DictConfig, cell: DictConfig | None = None) -> None:
    """Refuse a launcher that is not installed, and a cell with a launcher of its own."""
    launcher = OmegaConf.to_container(config.hydra.launcher, resolve=False)
    if isinstance(launcher, dict) and "install" in launcher:  # see hydra_plugins/xrgs_sweeper.py
        name, package = config.hydra.runtime.choices["hydra/launcher"], launcher["install"]
        raise XrgsError(f"hydra/launcher={name} is not installed: pip install '{package}'")
    if cell is None or OmegaConf.to_container(cell.hydra.launcher, resolve=False) == launcher:
        return
    raise XrgsError(
        "a launcher is chosen once for a sweep: set hydra/launcher and hydra.launcher.* on the "
        "command line or in a file of sweeps/, not in an ablation or in another swept config"
    )
