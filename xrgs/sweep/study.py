"""The plan of a study, and the way its cells go to Hydra's launcher.

expand (axes, matching baselines) -> compose -> variants -> identities -> launch -> record -> table

A cell with `matched_to` takes a number from another cell, so it has no identity before that one is
done: cells are launched as they become ready, those that wait for others after them. A cell that
another sweep trains is left to that, and waited for when nothing else is to do.
"""

from __future__ import annotations

import itertools
import re
import time
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import CompactHydraException
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from xrgs.capture import scenes, variant
from xrgs.config import to_conf
from xrgs.errors import XrgsError
from xrgs.evaluation.lpips import weights
from xrgs.experiment.store import Store
from xrgs.runtime.progress import say as _say
from xrgs.safeio.hashing import digest, plain
from xrgs.safeio.records import StoreError
from xrgs.sweep import launch, locks
from xrgs.sweep.estimate import RuntimeEstimator
from xrgs.sweep.jobs import worker
from xrgs.sweep.jobs.job import FAIL_FAST, LOCKED, UNWRITABLE
from xrgs.sweep.monitor import View
from xrgs.sweep.plan import (
    BASELINE,
    CellSpec,
    Planned,
    describe,
    estimated,
    identified,
    ready,
    record,
)

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from hydra.core.override_parser.types import Override
    from hydra.types import HydraContext, TaskFunction
    from omegaconf import DictConfig

    from xrgs.config import Conf

_SEED = re.compile(r"seed=(\d+)")
_NOTHING_LOST = "What is done is kept: with room to write, the same command goes on from there."
#: Seconds between looks at what other sweeps do.
_LOOK_S = 2.0


def _values(override: Override) -> list[str]:
    key = override.get_key_element()
    if not override.is_sweep_override():
        return [f"{key}={override.get_value_element_as_str()}"]
    if not override.is_discrete_sweep():
        raise XrgsError(f"{override.input_line}: an axis must be a list of values")
    return [f"{key}={value}" for value in override.sweep_string_iterator()]


def _is_change(key: str) -> bool:
    return key in {"ablation", "matched_to"} or key.startswith("components.")


def _label(changes: Iterable[tuple[str, str]]) -> str:
    parts = [
        value.strip("[]").replace(",", "+").replace(" ", "").replace("'", "")
        if key == "ablation"
        else f"{key.removeprefix('components.')}={value}"
        for key, value in changes
    ]
    return " ".join(part for part in parts if part) or BASELINE


def expand(arguments: Sequence[str]) -> list[CellSpec]:
    """Every combination of the axes, each group of them with its matching baseline first.

    Args:
        arguments: Hydra overrides, e.g. `+ablation=consistency,loss_weighting` and `seed=0,1`.
    """
    overrides = OverridesParser.create().parse_overrides(list(arguments))
    axes = {override.get_key_element(): _values(override) for override in overrides}
    swept = {key for key, values in axes.items() if len(values) > 1}
    wishes: dict[CellSpec, None] = {}
    for combination in itertools.product(*axes.values()):
        named = dict(zip(axes, combination, strict=True))
        bare = {key: key.lstrip("+~") for key in named}
        shared = tuple(text for key, text in named.items() if not _is_change(bare[key]))
        changes = tuple(text for key, text in named.items() if _is_change(bare[key]))
        condition = " ".join(
            named[key].lstrip("+")
            for key in named
            if key in swept
            and not _is_change(bare[key])
            and bare[key].split(".")[0] not in {"scene", "seed"}
        )
        label = _label(
            (bare[key], named[key].partition("=")[2]) for key in named if _is_change(bare[key])
        )
        wishes[CellSpec(BASELINE, condition, shared, ())] = None
        if label != BASELINE:
            wishes[CellSpec(label, condition, shared, changes)] = None
    return list(wishes)


class Study:
    """One call of `xrgs-sweep`."""

    def __init__(self, context: HydraContext, task: TaskFunction, config: DictConfig) -> None:
        self._context = context
        self._task = task
        self._config = config
        self._composed: dict[tuple[str, ...], Conf] = {}

    def run(self, arguments: Sequence[str]) -> None:
        """Plan, build the variants, run what is not done, record and report.

        Raises:
            CompactHydraException: the user can mend it; Hydra prints its message alone.
            SystemExit: with 1, where a cell failed; the table is printed first.
        """
        try:
            failed = self._run(arguments)
        except (XrgsError, OmegaConfBaseException) as error:
            raise CompactHydraException(str(error)) from error
        except OSError as error:
            if not worker.unwritable(error):
                raise
            store = self._config.store
            raise CompactHydraException(f"store={store}: {error}. {_NOTHING_LOST}") from error
        if failed:
            raise SystemExit(1)

    def _run(self, arguments: Sequence[str]) -> bool:
        launch.check(self._config)
        plan = self._plan(arguments)
        store = Store(Path(plan[0].conf.store))
        dry = plan[0].conf.dry_run
        if not dry:
            store.prepare()
        plan = self._with_variants(plan, store, build=not dry)
        plan = self._identified(plan, store)
        plan = estimated(plan, RuntimeEstimator(store))
        _say(describe(plan))
        if weights.find() is None and any(cell.state.name != "done" for cell in plan):
            _say(f"no LPIPS in what is run now (n/a in the tables): {weights.HINT}")
        if dry:
            return False
        _tidy({cell.cell_id for cell in plan if cell.cell_id and cell.state.name == "done"}, store)
        with View(store.cells) as view:
            plan = self._worked_off(plan, store, view)
        plan = [_without_reference(cell) for cell in plan]
        sweep_id = store.write_sweep(arguments, record(plan))
        from xrgs.report import build

        print(build(store.path, sweep_id).text)  # noqa: T201
        return any(cell.error is not None or cell.state.name != "done" for cell in plan)

    def _worked_off(self, plan: Sequence[Planned], store: Store, view: View) -> list[Planned]:
        """The plan when there is nothing left to do: run here, or by another sweep meanwhile.

        Raises:
            StoreError: the store takes no more.
        """
        conf = plan[0].conf
        retry, told, tried = conf.retry == "failed", False, set[str]()
        launches = launch.Launches(self._context, self._task, self._config)
        while True:
            view.watch(plan)
            wanted = ready(plan, tried, retry=retry)
            others = [cell for cell in plan if cell.state.name == "running"]
            if not wanted and not others:
                return list(plan)
            outcomes = launches.run(wanted.values(), store) if wanted else {}
            left = {LOCKED, launch.LOST}
            begun = {cell_id for cell_id in wanted if outcomes[cell_id] not in left}
            tried |= begun
            plan = self._identified(plan, store)
            if UNWRITABLE in outcomes.values():
                raise StoreError(f"store={store.path} can't be written. {_NOTHING_LOST}")
            failed = conf.fail_fast and "failed" in outcomes.values()
            if why := launches.stopped or (FAIL_FAST if failed else ""):
                _say(f"nothing more is started: {why}")
                return list(plan)
            if not wanted and not told:
                _say(f"waiting for {len(others)} cells: {others[0].name} {others[0].state.reason}")
                told = True
            if not begun:
                time.sleep(_LOOK_S)

    def _plan(self, arguments: Sequence[str]) -> list[Planned]:
        """Every cell that is asked for, behind the one it takes a number from."""
        plan: dict[CellSpec, Planned] = {}
        for wish in expand(arguments):
            cell = Planned(wish, self._compose(wish))
            if cell.reference is not None:
                plan.setdefault(
                    cell.reference, Planned(cell.reference, self._compose(cell.reference))
                )
            plan.setdefault(wish, cell)
        return list(plan.values())

    def _identified(self, plan: Sequence[Planned], store: Store) -> list[Planned]:
        """Every cell with its number, its identity and its state, as far as they are known."""
        found: dict[CellSpec, Planned] = {}
        held = locks.holders(store.locks)
        for cell in plan:
            known = identified(self._with_count(cell, found, store), store, held)
            found[known.wish] = known
        return list(found.values())

    def _with_count(
        self, cell: Planned, found: Mapping[CellSpec, Planned], store: Store
    ) -> Planned:
        """The cell with the number that it waits for, if the cell that has it is done."""
        reference = found.get(cell.reference) if cell.waits and cell.reference else None
        if reference is None or reference.cell_id is None or reference.state.name != "done":
            return cell
        count = store.cell(reference.cell_id).summary()["gaussians"]
        changes = (*cell.wish.changes, f"components.count_matched.gaussians={count}")
        wish = replace(cell.wish, changes=changes)
        return replace(cell, wish=wish, conf=self._compose(wish))

    def _compose(self, wish: CellSpec) -> Conf:
        """The wish's config. Seeds share one: composing takes Hydra tens of milliseconds."""
        seeds = [found[1] for text in wish.overrides if (found := _SEED.fullmatch(text))]
        others = tuple(text for text in wish.overrides if not _SEED.fullmatch(text))
        known = self._composed.get(others)
        if len(seeds) == 1 and known is not None:
            return replace(known, seed=int(seeds[0]))
        composed = self._context.config_loader.load_sweep_config(self._config, wish.overrides)
        launch.check(self._config, composed)
        conf = to_conf(composed)
        if "${seed" not in str(OmegaConf.to_container(composed, resolve=False)):
            self._composed[others] = conf
        return conf

    def _with_variants(
        self, plan: Sequence[Planned], store: Store, *, build: bool
    ) -> list[Planned]:
        """Every cell with its frozen variant; each is built once, and fails alone."""
        found: dict[str, tuple[str | None, str | None]] = {}
        cells = []
        for cell in plan:
            wanted = digest([plain(cell.conf.scene), plain(cell.conf.variant)])
            if wanted not in found:
                found[wanted] = _variant_of(cell.conf, store, build=build)
            variant_id, error = found[wanted]
            cells.append(replace(cell, variant_id=variant_id, error=error))
        return cells


def _variant_of(conf: Conf, store: Store, *, build: bool) -> tuple[str | None, str | None]:
    """The id of the frozen variant, or why there is none: like a cell, a failed scene stays so."""
    wanted = None
    try:
        wanted = variant.key(conf.scene, conf.variant)
        found = variant.find(store.variants, wanted)
        if found is not None:
            return found.id, None
        failed = None if conf.retry == "failed" else variant.failure(store.variants, wanted)
        if failed or not build:
            return None, failed
        _say(f"{scenes.label(conf.scene)}: building the mixed-resolution variant")
        return worker.run("variant", {"conf": asdict(conf), "store": conf.store})["variant"], None
    except worker.UnwritableError as error:
        raise StoreError(f"store={store.path}: {error}. {_NOTHING_LOST}") from error
    except XrgsError as error:
        _say(f"{scenes.label(conf.scene)}: {error}")
        if build:
            store.prepare()  # COLMAP dies of a full disk without a word: no fault of the scene's
        # As it is remembered: the record of a sweep is the same, whichever time it is planned.
        remembered = variant.failure(store.variants, wanted) if wanted else None
        return None, remembered or str(error)


def _tidy(done: set[str], store: Store) -> None:
    """Remove what a killed sweep left of cells that are done: a checkpoint, a lock."""
    for cell_id in done:
        store.cell(cell_id).drop_checkpoint()
    for cell_id in done & locks.names(store.locks):
        lock = locks.acquire(store.locks, cell_id)
        if lock is not None:
            lock.release()


def _without_reference(cell: Planned) -> Planned:
    """Nothing is left to be launched: a cell that still waits has waited in vain."""
    if cell.error is not None or not cell.waits:
        return cell
    return replace(cell, error=f"matched_to={cell.conf.matched_to}: that cell is not done")
