"""The way of a sweep's cells to Hydra's launcher, whichever is configured, and what may go wrong.

A launcher runs its jobs here or elsewhere, in processes with a working folder of their own. So a
job is told what it can't find out there: its folders by their full paths, the rasterizer, and its
share of the cores. What has become of a cell is read in the store: a launcher that breaks takes
its answers along, and not the sweep.
"""

from __future__ import annotations

import copy
import time
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hydra.core.override_parser.types import Quote, QuotedString
from hydra.core.plugins import Plugins
from omegaconf import OmegaConf, flag_override

from xrgs.errors import XrgsError
from xrgs.runtime.machine import usable_cores
from xrgs.runtime.progress import say
from xrgs.splat.backend import resolve_backend
from xrgs.sweep import locks
from xrgs.sweep.jobs import worker
from xrgs.sweep.jobs.job import STOPPED, SweepSession
from xrgs.sweep.plan import length

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from hydra.core.utils import JobReturn
    from hydra.types import HydraContext, TaskFunction
    from omegaconf import DictConfig

    from xrgs.experiment.store import Store
    from xrgs.sweep.plan import Planned

#: What a job ends with beside what `xrgs.sweep.jobs.job` says: its launcher gave no answer for it.
LOST = "lost"
#: A cell that was begun and lost so many times is left.
_LOSSES = 3
#: Seconds between looks at jobs that a broken launcher has left behind.
_LOOK_S = 2.0


@dataclass(frozen=True)
class Capacity:
    """What a launcher does with the jobs of one launch."""

    at_once: int | None = None
    """How many it runs at the same time on this machine; None where that is its own affair."""
    cores: int = 0
    """Of a job; 0 divides this machine's among those that run at once, or leaves it to the job."""
    batch: int | None = None
    """How many it may be given in one launch; None for any number."""
    settings: Mapping[str, Any] = field(default_factory=dict)
    """Its own settings that say so, by their keys in `hydra.launcher`."""

    def threads(self, jobs: int, machine: int) -> int:
        """Threads of each of `jobs` jobs on a machine of so many cores; 0 lets the job find out."""
        if self.cores or self.at_once is None:
            return self.cores
        return max(1, machine // min(self.at_once, jobs))


def capacity(launcher: DictConfig, threads: int, machine: int) -> Capacity:
    """What a launcher is to do, from its configuration.

    Args:
        launcher: `hydra.launcher`.
        threads: of a cell, as the user wants them; 0 for no wish.
        machine: cores that may be used here.

    Raises:
        XrgsError: the launcher's configuration makes no sense.
    """
    kind = str(launcher["_target_"]).rpartition(".")[2]
    if kind == "BasicLauncher":
        return Capacity(at_once=1, cores=threads)
    if kind == "JoblibLauncher":
        jobs = int(launcher["n_jobs"])
        if jobs == 0:
            raise XrgsError("hydra.launcher.n_jobs=0: say how many cells to run at once")
        if jobs < 0:  # joblib's -1 is one for each core, -2 leaves a core free
            jobs = max(1, (machine + 1 + jobs) // max(1, threads))
        # Cells that are found done end at once, from which joblib would learn to hand out several.
        return Capacity(jobs, threads, settings={"n_jobs": jobs, "batch_size": 1})
    if kind == "LocalLauncher":
        cores = launcher["cpus_per_task"] or threads
        jobs = max(1, machine // max(1, cores))
        return Capacity(jobs, cores, batch=jobs)  # submitit starts all that it is given at once
    if kind == "SlurmLauncher":
        cores = launcher["cpus_per_task"] or threads or 1
        return Capacity(cores=cores, settings={"cpus_per_task": cores})
    if kind == "RayLauncher":
        cores = max(1, int(launcher["ray"]["remote"].get("num_cpus", threads or 1)))
        return Capacity(cores=cores, settings={"ray.remote.num_cpus": cores})
    return Capacity(cores=threads)


def check(config: DictConfig, cell: DictConfig | None = None) -> None:
    """That there is a launcher, and that a cell does not ask for another one.

    Args:
        config: the sweep's, as composed from the command line.
        cell: of one cell; Hydra would not look at the launcher that it names.

    Raises:
        XrgsError: there is none, or it does.
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


class Launches:
    """The launches of one call of `xrgs-sweep`."""

    def __init__(self, context: HydraContext, task: TaskFunction, config: DictConfig) -> None:
        self._name = str(config.hydra.runtime.choices["hydra/launcher"])
        self._context, self._task = context, task
        self._config = copy.deepcopy(config)
        self._call: SweepSession | None = None
        self._jobs = 0
        self._losses: Counter[str] = Counter()
        self._suspects: set[str] = set()

    def _begin(self) -> SweepSession:
        """This call, in a folder whose name is the same everywhere.

        A job composes its config anew: `now` is another time there, and `.` another folder.
        """
        folder = _folder_of_its_own(Path(self._config.hydra.sweep.dir).absolute())
        self._set("sweep.dir", _literal(folder))
        given = self._config.hydra.overrides.hydra
        self._set("overrides.hydra", [*given, f"hydra.sweep.dir={_quoted(folder)}"])
        call = SweepSession(folder)
        call.begin()
        return call

    def _set(self, key: str, value: Any) -> None:
        with flag_override(self._config.hydra, ["readonly", "struct"], False):
            OmegaConf.update(self._config.hydra, key, value)

    @property
    def stopped(self) -> str:
        """Why no job begins any more; empty while they may."""
        return self._call.stopped if self._call else ""

    def run(self, cells: Iterable[Planned], store: Store) -> dict[str, str]:
        """Run cells that have an identity, the longest first.

        Returns:
            What each cell's job ended with, by the cell's id: what `run_job` returned, or `LOST`
            where it may be tried again, or the state in which its last loss left it.

        Raises:
            XrgsError: the launcher can't be used, or begins nothing.
        """
        self._call = call = self._call or self._begin()
        cells = sorted(cells, key=length, reverse=True)
        threads, machine = max(cell.conf.threads for cell in cells), usable_cores()
        allowed = capacity(self._config.hydra.launcher, threads, machine)
        for key, value in allowed.settings.items():
            self._set(f"launcher.{key}", value)
        outcomes: dict[str, str] = {}
        for batch in self._batches(cells, allowed.batch or len(cells)):
            if call.stopped:
                outcomes |= {str(cell.cell_id): STOPPED for cell in batch}
                continue
            outcomes |= self._launch(batch, allowed.threads(len(batch), machine), store)
        return outcomes

    def _batches(self, cells: Sequence[Planned], size: int) -> list[Sequence[Planned]]:
        """Suspects come last and alone: one of them may have been the others' undoing."""
        others = [cell for cell in cells if cell.cell_id not in self._suspects]
        suspects = [cell for cell in cells if cell.cell_id in self._suspects]
        return [
            *(others[start : start + size] for start in range(0, len(others), size)),
            *([cell] for cell in suspects),
        ]

    def _launch(self, cells: Sequence[Planned], threads: int, store: Store) -> dict[str, str]:
        if self._name != "basic":
            say(f"hydra/launcher={self._name}: {len(cells)} cells, threads={threads} each")
        first, self._jobs = self._jobs, self._jobs + len(cells)
        try:
            launcher = Plugins.instance().instantiate_launcher(
                hydra_context=self._context, task_function=self._task, config=self._config
            )
            done = launcher.launch([_overrides(cell, threads) for cell in cells], first)
        except Exception as error:
            return self._lost(cells, error, store)
        return {
            str(cell.cell_id): self._outcome(cell, job, store)
            for cell, job in zip(cells, done, strict=True)
        }

    def _outcome(self, cell: Planned, job: JobReturn, store: Store) -> str:
        """What `run_job` returned. Where it raised, that is its cell's alone.

        submitit raises in a job at the end of its time, when it has started it again often enough.
        """
        try:
            return str(job.return_value)
        except Exception as error:
            say(f"{cell.name}: {_line(error)}")
        state = store.cell(str(cell.cell_id)).state().name
        return self._unanswered(str(cell.cell_id), state) if state == "unfinished" else "failed"

    def _unanswered(self, cell_id: str, state: str) -> str:
        """What a cell's job ended with, by the state that it left the cell in."""
        self._losses[cell_id] += state == "unfinished"
        ended = state in {"done", "failed"} or self._losses[cell_id] >= _LOSSES
        return state if ended else LOST

    def _lost(self, cells: Sequence[Planned], error: Exception, store: Store) -> dict[str, str]:
        """What has become of cells whose launcher broke: it dropped those it had not begun too."""
        reason = f"hydra/launcher={self._name}: {_line(error)}"
        were = {str(cell.cell_id): cell.state.name for cell in cells}
        while were.keys() & locks.holders(store.locks).keys():
            time.sleep(_LOOK_S)  # jobs that outlive it have their cores still
        states = {cell_id: store.cell(cell_id).state().name for cell_id in were}
        if all(states[cell_id] in {were[cell_id], "absent"} - {"unfinished"} for cell_id in were):
            raise XrgsError(f"{reason}\nIt began no cell.") from error
        self._suspects |= {cell_id for cell_id in states if states[cell_id] == "unfinished"}
        outcomes = {cell_id: self._unanswered(cell_id, state) for cell_id, state in states.items()}
        say(f"{reason}\nof its {len(cells)} cells are left:")
        for cell in cells:
            outcome, state = outcomes[str(cell.cell_id)], states[str(cell.cell_id)]
            if state not in {"done", "failed"}:
                way = state if outcome == LOST else f"lost {_LOSSES} times, not tried again"
                say(f"  {cell.cell_id}  {cell.name}  ({way})")
        return outcomes


def _line(error: Exception) -> str:
    return f"{type(error).__name__}: {str(error).strip().partition(chr(10))[0]}"


def _folder_of_its_own(wanted: Path) -> Path:
    """The folder made, or one beside it: another call may have it, by the clock or by its name."""
    number, folder = 1, wanted
    while True:
        try:
            folder.mkdir(parents=True)
        except FileExistsError:
            number += 1
            folder = wanted.with_name(f"{wanted.name}-{number}")
        except OSError as error:
            if worker.unwritable(error):
                raise
            raise XrgsError(f"hydra.sweep.dir={wanted}: {error}") from error
        else:
            return folder


def _literal(path: Path) -> str:
    """A path as a value of a config, where `${` would begin an interpolation."""
    return str(path).replace("${", r"\${")


def _quoted(path: Path) -> str:
    """A path as a value of Hydra's command line."""
    return QuotedString(_literal(path), Quote.single).with_quotes()


def _overrides(cell: Planned, threads: int) -> list[str]:
    """A cell's, and what a job elsewhere would not find by itself."""
    conf = cell.conf
    told = {
        "store": _quoted(Path(conf.store).absolute()),
        "splat.backend": resolve_backend(conf.splat.backend),
        "threads": str(conf.threads or threads),
    }
    if conf.scene.path:
        told["scene.path"] = _quoted(Path(conf.scene.path).expanduser().absolute())
    return [*cell.wish.overrides, *(f"{key}={value}" for key, value in told.items())]
