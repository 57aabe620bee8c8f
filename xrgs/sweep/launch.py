"""Hands a sweep's cells to Hydra's launcher, and goes on when the launcher breaks.

A launcher runs jobs here or elsewhere, in processes with working folders of their own. A job is
given the session's folder, the store and the id of its cell. The cell's folder in the store holds
the config, with full paths, the rasterizer and the job's share of the cores. The outcome of a cell
is read from the store, so that a launcher that breaks loses its answers and nothing else.
"""

from __future__ import annotations

import copy
import os
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from hydra.core.plugins import Plugins
from hydra.types import HydraContext
from omegaconf import OmegaConf, flag_override

from xrgs.composing import escape_interpolations
from xrgs.errors import XrgsError
from xrgs.runtime import lease
from xrgs.runtime.machine import gpus, usable_cores
from xrgs.runtime.progress import log_line
from xrgs.safeio.paths import user_path
from xrgs.safeio.sanitize import counted, for_line
from xrgs.splat.backend import resolve_backend
from xrgs.store.attempts import plan_cell
from xrgs.sweep.jobs import worker
from xrgs.sweep.jobs.job import INTERRUPTED, STOPPED
from xrgs.sweep.plan import expected_length
from xrgs.sweep.session import SweepSession

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from hydra.core.config_loader import ConfigLoader
    from hydra.core.utils import JobReturn
    from hydra.types import TaskFunction
    from omegaconf import DictConfig

    from xrgs.store.store import Store
    from xrgs.sweep.plan import PlannedCell

#: Outcome of a job without an answer; the cell may be launched again.
LOST = "lost"
#: A cell is not launched again after so many jobs that began it and gave no answer.
_MAX_LOSSES = 3
#: Seconds between two looks at the jobs that a broken launcher has left behind.
_POLL_S = 2.0


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

        Args:
            jobs: Number of jobs of the batch.
            machine: Cores of this machine.
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


#: The capacity of each launcher, by its class: a function of `hydra.launcher`, the threads that a
#: cell asks for (0 for no preference) and the cores of this machine. Another launcher is one
#: function and one line.
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
    Other launchers run no more jobs at once than this machine has GPUs; a job takes a free one
    (`xrgs.sweep.jobs.job`). A launcher that is not in `CAPACITIES` decides by itself.

    Args:
        launcher: `hydra.launcher`.
        allowed: The capacity without GPUs.
        count: Number of GPUs of this machine.

    Raises:
        XrgsError: The jobs run on this machine, and it has no GPU.
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
    """Return how many jobs a launcher runs at once, and with how many cores.

    Args:
        launcher: `hydra.launcher`. One that is not in `CAPACITIES` decides by itself.
        threads: Threads of a cell that the user asks for; 0 for no preference.
        machine: Cores that this process may use.

    Raises:
        XrgsError: The launcher's configuration is invalid.
    """
    known = CAPACITIES.get(str(launcher["_target_"]).rpartition(".")[2])
    return known(launcher, threads, machine) if known else Capacity(cores=threads)


def check(config: DictConfig, cell: DictConfig | None = None) -> None:
    """Refuse a launcher that is not installed, and a cell with a launcher of its own.

    Raises:
        XrgsError: The message says what to install, or where to choose the launcher.
    """
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


class _JobConfigLoader:
    """Gives each job Hydra's own settings and the id of its cell, and composes no config.

    Launchers ask the config loader for a job's config, on the machine that runs the job. Hydra's
    loader would compose the cell's config a second time.
    """

    def load_sweep_config(self, master_config: DictConfig, overrides: list[str]) -> DictConfig:
        """Return the sweep's `hydra` node with `cell` (its id), `store` and `name` of one job.

        Raises:
            XrgsError: The session's folder is no longer there. Hydra would make it again.
        """
        folder = master_config.hydra.sweep.dir
        if not SweepSession(Path(folder)).exists:
            raise XrgsError(f"hydra.sweep.dir={folder} is no longer there")
        config = OmegaConf.masked_copy(master_config, ["hydra"])
        with flag_override(config, ["readonly", "struct"], False):
            for override in overrides:
                # As text: an id of digits alone, or like 12e4567..., would be parsed as a number.
                key, _, value = override.partition("=")
                config[key] = escape_interpolations(value)
        with flag_override(config.hydra, ["readonly", "struct"], False):
            config.hydra.overrides.task = overrides[:1]
            config.hydra.job.override_dirname = overrides[0]
        OmegaConf.set_readonly(config.hydra, False)
        return config


class Launches:
    """The launches of one call of `xrgs-sweep`."""

    def __init__(self, context: HydraContext, task: TaskFunction, config: DictConfig) -> None:
        """Prepare to launch, as `Study`; nothing is written before the first launch."""
        self._name = str(config.hydra.runtime.choices["hydra/launcher"])
        loader = cast("ConfigLoader", _JobConfigLoader())  # launchers call nothing else of it
        self._context = HydraContext(loader, context.callbacks)
        self._task = task
        self._config = copy.deepcopy(config)
        self._session: SweepSession | None = None
        self._jobs = 0
        self._losses: Counter[str] = Counter()
        self._suspects: set[str] = set()

    def _begin(self, store: Store) -> SweepSession:
        """Create the session's folder, and give its full path to every job."""
        folder = _create_unique(user_path(self._config.hydra.sweep.dir).absolute(), store)
        self._set("sweep.dir", escape_interpolations(str(folder)))
        session = SweepSession(folder)
        session.begin()
        return session

    def end(self) -> None:
        """Tidy up after the last launch, whose jobs have all ended."""
        if self._session is not None:
            self._session.end()

    def _set(self, key: str, value: Any) -> None:
        with flag_override(self._config.hydra, ["readonly", "struct"], False):
            OmegaConf.update(self._config.hydra, key, value)

    @property
    def stopped(self) -> str:
        """Why no further job may begin; empty while they may."""
        return self._session.stopped if self._session else ""

    def launch(self, cells: Iterable[PlannedCell], store: Store) -> dict[str, str]:
        """Launch cells that have an identity, the longest first, and wait for them.

        Returns:
            The outcome of each cell's job by the cell's id: what `run_job` returned, `LOST` if the
            cell may be launched again, or the cell's state after its last loss.

        Raises:
            XrgsError: The launcher can't be used, or begins no job; or the store is gone.
        """
        self._session = session = self._session or self._begin(store)
        cells = sorted(cells, key=expected_length, reverse=True)
        threads, machine = max(cell.conf.threads for cell in cells), usable_cores()
        launcher = self._config.hydra.launcher
        allowed = capacity(launcher, threads, machine)
        if any(cell.conf.splat.backend == "gsplat" for cell in cells):
            allowed = one_cell_a_gpu(launcher, allowed, len(gpus()))
        for key, value in allowed.settings.items():
            self._set(f"launcher.{key}", value)
        outcomes: dict[str, str] = {}
        for batch in self._batches(cells, allowed.batch or len(cells)):
            if session.stopped:
                outcomes |= {str(cell.cell_id): STOPPED for cell in batch}
                continue
            outcomes |= self._launch_batch(batch, allowed.threads(len(batch), machine), store)
        return outcomes

    def _batches(self, cells: Sequence[PlannedCell], size: int) -> list[Sequence[PlannedCell]]:
        """Divide cells into batches; cells that may have broken a launcher come last, alone."""
        others = [cell for cell in cells if cell.cell_id not in self._suspects]
        suspects = [cell for cell in cells if cell.cell_id in self._suspects]
        return [
            *(others[start : start + size] for start in range(0, len(others), size)),
            *([cell] for cell in suspects),
        ]

    def _launch_batch(
        self, cells: Sequence[PlannedCell], threads: int, store: Store
    ) -> dict[str, str]:
        if self._name != "basic":
            number = counted(len(cells), "cell")
            log_line(f"hydra/launcher={self._name}: {number}, threads={threads} each")
        overrides = [_hand_over(cell, threads, store) for cell in cells]
        first, self._jobs = self._jobs, self._jobs + len(cells)
        try:
            if "submitit" in str(self._config.hydra.launcher["_target_"]):
                from xrgs.sweep import submitit_jobs  # submitit is an extra

                submitit_jobs.follow()
            launcher = Plugins.instance().instantiate_launcher(
                hydra_context=self._context, task_function=self._task, config=self._config
            )
            returned = launcher.launch(overrides, first)
        except Exception as error:
            store.check_not_gone()
            return self._after_loss(cells, error, store)
        return {
            str(cell.cell_id): self._outcome(cell, job, store)
            for cell, job in zip(cells, returned, strict=True)
        }

    def _outcome(self, cell: PlannedCell, job: JobReturn, store: Store) -> str:
        """Return what `run_job` returned. An exception in a job concerns its own cell alone."""
        try:
            answer = str(job.return_value)
        except Exception as error:  # submitit raises for a job that was out of time too often
            log_line(f"{cell.name}: {_first_line(error)}")
        else:
            if answer == INTERRUPTED:
                log_line(f"{cell.name}: its job was asked to end; the next sweep continues it")
            return answer
        state = store.cell(str(cell.cell_id)).state().name
        if state == "unfinished":
            return self._after_silence(str(cell.cell_id), state)
        return "done" if state == "done" else "failed"

    def _after_silence(self, cell_id: str, state: str) -> str:
        """Return the outcome of a job without an answer, from the state of its cell."""
        self._losses[cell_id] += state == "unfinished"
        ended = state in {"done", "failed"} or self._losses[cell_id] >= _MAX_LOSSES
        return state if ended else LOST

    def _after_loss(
        self, cells: Sequence[PlannedCell], error: Exception, store: Store
    ) -> dict[str, str]:
        """Return the outcome of each cell after the launcher raised."""
        reason = f"hydra/launcher={self._name}: {_first_line(error)}"
        before = {str(cell.cell_id): cell.state.name for cell in cells}
        while before.keys() & lease.holders(store.leases).keys():
            time.sleep(_POLL_S)  # jobs that outlive their launcher still use their cores
        states = {cell_id: store.cell(cell_id).state().name for cell_id in before}
        unchanged = {
            cell_id: state != "unfinished" and state in {before[cell_id], "planned"}
            for cell_id, state in states.items()
        }
        if all(unchanged.values()):
            raise XrgsError(f"{reason}. The launcher began no cell.") from error
        self._suspects |= {cell_id for cell_id in states if states[cell_id] == "unfinished"}
        outcomes = {cell: self._after_silence(cell, state) for cell, state in states.items()}
        log_line(reason)
        log_line(f"of its {len(cells)} cells these are not finished:")
        for cell in cells:
            outcome, state = outcomes[str(cell.cell_id)], states[str(cell.cell_id)]
            if state not in {"done", "failed"}:
                note = state if outcome == LOST else f"lost {_MAX_LOSSES} times, not tried again"
                log_line(f"  {cell.cell_id}  {cell.name}  ({note})")
        return outcomes


def _first_line(error: Exception) -> str:
    return for_line(f"{type(error).__name__}: {str(error).strip().partition(chr(10))[0]}")


def _create_unique(preferred: Path, store: Store) -> Path:
    """Create a folder, with a number appended to its name if another call has the name already."""
    home = store.path.absolute()
    try:
        # The store itself is not made again: it may have been moved since the plan.
        above = preferred.parent
        if not above.is_relative_to(home) or home.is_dir():
            above.mkdir(parents=True, exist_ok=True)
        folder, number = preferred, 1
        while True:
            try:
                folder.mkdir()
            except FileExistsError:
                number += 1
                folder = preferred.with_name(f"{preferred.name}-{number}")
            else:
                return folder
    except OSError as error:
        if worker.unwritable(error):
            raise
        raise XrgsError(f"hydra.sweep.dir={preferred}: {error}") from error


def _hand_over(cell: PlannedCell, threads: int, store: Store) -> list[str]:
    """Write a cell's config for a job on any machine; return the overrides of the job."""
    if cell.identity is None or cell.cell_id is None:
        raise ValueError(f"{cell.name}: launched without an identity")
    home, scene = store.path.absolute(), cell.conf.scene
    path, masks = (
        str(user_path(text).absolute()) if text else text for text in (scene.path, scene.masks)
    )
    conf = replace(
        cell.conf,
        store=str(home),
        splat=replace(cell.conf.splat, backend=resolve_backend(cell.conf.splat.backend)),
        threads=cell.conf.threads or threads,
        scene=replace(scene, path=path, masks=masks),
    )
    # Under the lease: another sweep may be training the cell, or have finished it, since the plan.
    held = lease.acquire(store.leases, cell.cell_id)
    if held is not None:
        try:
            state = store.cell(cell.cell_id).state(verify=False)
            if state.name != "done" and not state.unreadable:
                plan_cell(store.cell(cell.cell_id), conf, cell.identity)
        finally:
            held.release()
    return [f"cell={cell.cell_id}", f"store={home}", f"name={cell.name}"]
