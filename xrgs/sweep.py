"""The plan of a study, and the way its cells go to Hydra's launcher.

expand (axes, matching baselines) -> compose -> variants -> identities -> launch -> record -> table

A cell with `matched_to` takes a number from another cell, so it has no identity before that one is
done: cells are launched as they become ready, those that wait for others after them.
"""

from __future__ import annotations

import itertools
import sys
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.plugins import Plugins
from hydra.errors import CompactHydraException
from omegaconf.errors import OmegaConfBaseException

from xrgs import scenes, variant, weights, worker
from xrgs.config import to_conf
from xrgs.errors import XrgsError
from xrgs.hashing import digest
from xrgs.identity import cell_identity
from xrgs.splat.backend import resolve_backend
from xrgs.store import State, Store

if TYPE_CHECKING:
    from collections.abc import Container, Iterable, Mapping, Sequence

    from hydra.core.override_parser.types import Override
    from hydra.types import HydraContext, TaskFunction
    from omegaconf import DictConfig

    from xrgs.config import Conf

BASELINE = "baseline"


@dataclass(frozen=True)
class Wish:
    """One combination of the command line's axes."""

    label: str
    """What is compared: the ablation and the component values set by hand."""
    condition: str
    """The other axes' values, beside scene and seed: what label and baseline share."""
    shared: tuple[str, ...]
    """Overrides that the matching baseline has too."""
    changes: tuple[str, ...]
    """Overrides that make it another program than the baseline."""

    @property
    def overrides(self) -> list[str]:
        """All of it, for Hydra to compose."""
        return [*self.shared, *self.changes]


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


def expand(arguments: Sequence[str]) -> list[Wish]:
    """Every combination of the axes, each group of them with its matching baseline first.

    Args:
        arguments: Hydra overrides, e.g. `+ablation=consistency,loss_weighting` and `seed=0,1`.
    """
    overrides = OverridesParser.create().parse_overrides(list(arguments))
    axes = {override.get_key_element(): _values(override) for override in overrides}
    swept = {key for key, values in axes.items() if len(values) > 1}
    wishes: dict[Wish, None] = {}
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
        wishes[Wish(BASELINE, condition, shared, ())] = None
        if label != BASELINE:
            wishes[Wish(label, condition, shared, changes)] = None
    return list(wishes)


@dataclass(frozen=True)
class Planned:
    """A cell of the study: what it is, and where it stands."""

    wish: Wish
    conf: Conf
    variant_id: str | None = None
    cell_id: str | None = None
    state: State = field(default_factory=lambda: State("absent"))
    error: str | None = None
    """Why the cell can't be run: its scene failed, or the cell that it takes a number from."""

    @property
    def name(self) -> str:
        """For people."""
        parts = (scenes.label(self.conf.scene), self.wish.label, self.wish.condition)
        return " / ".join(part for part in parts if part) + f" / seed {self.conf.seed}"

    @property
    def reference(self) -> Wish | None:
        """The cell whose number of Gaussians this one is to have."""
        name = self.conf.matched_to
        return replace(self.wish, label=name, changes=(f"+ablation={name}",)) if name else None

    @property
    def waits(self) -> bool:
        """Whether that number is still to come."""
        return self.reference is not None and not self.conf.components.count_matched.gaussians


def _say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)  # noqa: T201


class Study:
    """One call of `xrgs-sweep`."""

    def __init__(self, context: HydraContext, task: TaskFunction, config: DictConfig) -> None:
        self._context = context
        self._task = task
        self._config = config

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
        if failed:
            raise SystemExit(1)

    def _run(self, arguments: Sequence[str]) -> bool:
        plan = self._plan(arguments)
        store = Store(Path(plan[0].conf.store))
        dry = plan[0].conf.dry_run
        if not dry:
            store.prepare()
        plan = self._with_variants(plan, store, build=not dry)
        plan = self._identified(plan, store)
        _say(describe(plan))
        if weights.find() is None and any(cell.state.name != "done" for cell in plan):
            _say(f"no LPIPS in what is run now (n/a in the tables): {weights.HINT}")
        if dry:
            return False
        launched: set[str] = set()
        while ready := _ready(plan, launched):
            self._launch(ready.values())
            launched |= ready.keys()
            plan = self._identified(plan, store)
        plan = [_without_reference(cell) for cell in plan]
        sweep_id = store.write_sweep(arguments, _record(plan))
        from xrgs.report import build

        print(build(store.path, sweep_id).text)  # noqa: T201
        return any(cell.error is not None or cell.state.name != "done" for cell in plan)

    def _plan(self, arguments: Sequence[str]) -> list[Planned]:
        """Every cell that is asked for, behind the one it takes a number from."""
        plan: dict[Wish, Planned] = {}
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
        found: dict[Wish, Planned] = {}
        for cell in plan:
            known = _identify(self._with_count(cell, found, store), store)
            found[known.wish] = known
        return list(found.values())

    def _with_count(self, cell: Planned, found: Mapping[Wish, Planned], store: Store) -> Planned:
        """The cell with the number that it waits for, if the cell that has it is done."""
        reference = found.get(cell.reference) if cell.waits and cell.reference else None
        if reference is None or reference.cell_id is None or reference.state.name != "done":
            return cell
        count = store.cell(reference.cell_id).summary()["gaussians"]
        changes = (*cell.wish.changes, f"components.count_matched.gaussians={count}")
        wish = replace(cell.wish, changes=changes)
        return replace(cell, wish=wish, conf=self._compose(wish))

    def _compose(self, wish: Wish) -> Conf:
        return to_conf(self._context.config_loader.load_sweep_config(self._config, wish.overrides))

    def _with_variants(
        self, plan: Sequence[Planned], store: Store, *, build: bool
    ) -> list[Planned]:
        """Every cell with its frozen variant; each is built once, and fails alone."""
        found: dict[str, tuple[str | None, str | None]] = {}
        cells = []
        for cell in plan:
            wanted = digest([asdict(cell.conf.scene), asdict(cell.conf.variant)])
            if wanted not in found:
                found[wanted] = _variant_of(cell.conf, store, build=build)
            variant_id, error = found[wanted]
            cells.append(replace(cell, variant_id=variant_id, error=error))
        return cells

    def _launch(self, cells: Iterable[Planned]) -> None:
        launcher = Plugins.instance().instantiate_launcher(
            hydra_context=self._context, task_function=self._task, config=self._config
        )
        launcher.launch([cell.wish.overrides for cell in cells], initial_job_idx=0)


def _variant_of(conf: Conf, store: Store, *, build: bool) -> tuple[str | None, str | None]:
    """The id of the frozen variant, or why there is none."""
    try:
        found = variant.find(store.variants, variant.key(conf.scene, conf.variant))
        if found is not None or not build:
            return (found.id if found else None), None
        _say(f"{scenes.label(conf.scene)}: building the mixed-resolution variant")
        return worker.run("variant", {"conf": asdict(conf), "store": conf.store})["variant"], None
    except XrgsError as error:
        _say(f"{scenes.label(conf.scene)}: {error}")
        return None, str(error)


def _identify(cell: Planned, store: Store) -> Planned:
    if cell.variant_id is None or cell.waits:
        return cell
    cell_id = digest(cell_identity(cell.conf, cell.variant_id))
    return replace(cell, cell_id=cell_id, state=store.cell(cell_id).state())


def _ready(plan: Sequence[Planned], launched: Container[str]) -> dict[str, Planned]:
    """The cells that can be run now and are not done, by their identity."""
    return {
        cell.cell_id: cell
        for cell in plan
        if cell.cell_id is not None
        and cell.cell_id not in launched
        and cell.error is None
        and cell.state.name != "done"
    }


def _without_reference(cell: Planned) -> Planned:
    """Nothing is left to be launched: a cell that still waits has waited in vain."""
    if cell.error is not None or not cell.waits:
        return cell
    return replace(cell, error=f"matched_to={cell.conf.matched_to}: that cell is not done")


def describe(plan: Sequence[Planned]) -> str:
    """The plan as lines: state, identity, name, and why where it is not plain."""
    lines = [f"plan: {len(plan)} cells, {sum(c.state.name == 'done' for c in plan)} done"]
    for cell in plan:
        state = "failed" if cell.error else "waits" if cell.waits else cell.state.name
        reason = (cell.error or cell.state.reason or "").partition("\n")[0]
        identity = cell.cell_id or ("no count yet" if cell.waits else "variant not built")
        lines.append(
            f"  {state:<10} {identity:<18} {cell.name}" + (f"  ({reason})" if reason else "")
        )
    return "\n".join(lines)


def _record(plan: Sequence[Planned]) -> list[dict[str, Any]]:
    """The rows that a report is made from: each cell with its matching baseline's id."""
    baselines = {c.wish.shared: c.cell_id for c in plan if c.wish.label == BASELINE}
    return [
        {
            "cell_id": cell.cell_id,
            "label": cell.wish.label,
            "condition": cell.wish.condition,
            "scene": scenes.label(cell.conf.scene),
            "seed": cell.conf.seed,
            "variant_id": cell.variant_id,
            "baseline_id": baselines[cell.wish.shared],
            "error": cell.error,
        }
        for cell in plan
    ]


def run_job(cfg: DictConfig) -> str:
    """What a launcher runs, perhaps on another machine: one cell, in a process of its own.

    Returns:
        The cell's state; a failed cell is a state, not an exception, so that no launcher drops
        the rest of its batch.
    """
    conf = to_conf(cfg)
    store = Store(Path(conf.store))
    found = variant.find(store.variants, variant.key(conf.scene, conf.variant))
    if found is None:
        raise XrgsError(f"{scenes.label(conf.scene)}: its variant is gone from {store.variants}")
    # Named, so that the child can't choose another one than the identity says.
    conf.splat.backend = resolve_backend(conf.splat.backend)
    identity = cell_identity(conf, found.id)
    folder = store.cell(digest(identity))
    folder.begin(asdict(conf), identity)
    _say(f"{scenes.label(conf.scene)} / seed {conf.seed}: training cell {folder.id}")
    request = {"conf": asdict(conf), "variant": str(found.path), "cell": str(folder.path)}
    try:
        worker.run("cell", request)
    except XrgsError as error:
        folder.fail(str(error))
        _say(f"{folder.id} failed: {error}")
    return folder.state().name
