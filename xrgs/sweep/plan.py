"""The planned cells of a study: their settings, states and costs, and the cells left to train.

A count-matched cell is a control for a claim of efficiency: it has as many Gaussians as another
cell, its reference (`xrgs.training.count_matching`).
"""

from __future__ import annotations

from collections.abc import Container, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from xrgs import plugins
from xrgs.config import Conf, identity_values
from xrgs.errors import XrgsError
from xrgs.mixture.paths import TO_TRY
from xrgs.mixture.split import check_variant_conf
from xrgs.photos import scenes
from xrgs.runtime.machine import usable_memory
from xrgs.runtime.text import format_duration, format_size
from xrgs.safeio.hashing import digest, to_plain
from xrgs.safeio.sanitize import counted, for_line
from xrgs.splat.backend import resolve_backend
from xrgs.splat.settings import SSIM_WINDOW
from xrgs.store.cell_folder import CellState
from xrgs.store.identity import cell_id, cell_identity
from xrgs.store.schema import Identity, RecordedCell
from xrgs.store.store import BASELINE, Store
from xrgs.sweep import build_variants
from xrgs.sweep.axes import CellSpec
from xrgs.sweep.estimate import TORCH_SLOWDOWN, Cost, CostEstimator

#: The condition of cells that hold no view out.
_ON_TRAINING_VIEWS = "scored on the training views"


@dataclass(frozen=True)
class PlannedCell:
    """A cell of the study with its settings and its state."""

    spec: CellSpec
    conf: Conf
    variant_id: str | None = None
    """The id of its frozen variant; None while the variant is not built."""
    identity: Identity | None = None
    """The cell's id is the digest of it; None while the variant or a count is missing."""
    cell_id: str | None = None
    state: CellState = field(default_factory=lambda: CellState("absent"))
    trained: float = 0.0
    """The share of its training that need not be repeated, 0 to 1: its checkpoint has it."""
    error: str | None = None
    """Why the cell can't be trained: its scene or its reference failed."""
    remembered: bool = False
    """Whether the store keeps the error of its scene, so that the scene is not tried again."""
    cost: Cost | None = None
    """The expected time, memory and disk; None if the store has no finished cell."""

    @property
    def seconds(self) -> float | None:
        """Expected seconds that are left to its end; None if unknown."""
        return self.cost.left_s(self.trained) if self.cost else None

    @property
    def name(self) -> str:
        """The cell's name for people: scene, label, condition and replicate."""
        draw = self.conf.variant.seed
        parts = (
            scenes.label(self.conf.scene),
            self.spec.label,
            self.spec.condition,
            f"variant.seed {draw}" if draw else "",
            f"seed {self.conf.seed}",
        )
        return " / ".join(part for part in parts if part)

    @property
    def reference(self) -> CellSpec | None:
        """The cell with the number of Gaussians that this one is to match; None if there is none.

        The reference has the scene, replicate and condition of this cell. Its label is the name of
        an ablation, names of several ablations joined by `+`, or `baseline`.
        """
        label = self.conf.matched_to
        if label is None:
            return None
        names = label.replace("+", ",")
        changes = (f"+ablation={names if names == label else f'[{names}]'}",)
        return replace(self.spec, label=label, changes=() if label == BASELINE else changes)

    @property
    def not_placed(self) -> bool:
        """Whether SfM has placed too few photographs of the cell's scene."""
        return self.remembered and self.conf.variant.poses is None

    @property
    def waits(self) -> bool:
        """Whether the cell waits for the number of Gaussians of its reference."""
        return self.reference is not None and not self.conf.components.count_matched.gaussians


def planned(spec: CellSpec, conf: Conf) -> PlannedCell:
    """Return a planned cell, with two additions from its config.

    The label of a count-matched cell gets the name of its reference. The condition gets the scored
    views where these are not test views.
    """
    scored = ""
    if conf.train.validation:
        if "train.validation=" not in spec.condition:
            scored = f"train.validation={conf.train.validation}"
    elif conf.variant.test_every == 0 and not conf.variant.test:
        scored = "" if _ON_TRAINING_VIEWS in spec.condition else _ON_TRAINING_VIEWS
    spec = replace(spec, condition=f"{spec.condition} {scored}".strip())
    if conf.matched_to is not None:
        spec = replace(spec, label=f"{spec.label} to {conf.matched_to}")
    return PlannedCell(spec, conf)


def check_sizes(conf: Conf) -> None:
    """Refuse a config with images too small for SSIM, or with invalid values of its variant."""
    check_variant_conf(conf.variant)
    side, least = conf.variant.long_side, conf.variant.factor * SSIM_WINDOW
    if 0 < side < least:
        raise XrgsError(
            f"variant.long_side={side}: must be 0 (the photographs' size) or at least {least}, so"
            f" that LR views have the {SSIM_WINDOW} px a side that SSIM needs"
        )


def check_plugins(confs: Iterable[Conf], *, imported: bool) -> None:
    """Refuse components of other packages that are not installed.

    With `imported`, those that can't be imported, or don't take their settings, are refused too.
    """
    used = {
        (name, repr(settings)): settings
        for conf in confs
        for name, settings in conf.components.plugins.items()
    }
    for (name, _), settings in used.items():
        plugins.find(name)
        if imported:
            plugins.check(name, settings)


def with_variants(
    plan: Sequence[PlannedCell], store: Store, *, allow_build: bool
) -> tuple[list[PlannedCell], list[str]]:
    """Return the cells with their variants, or with the reasons why there are none.

    The notes on the variants are returned too, each with its scene. `allow_build` is as for
    `build_variants.plan`.
    """
    keys = [digest([to_plain(cell.conf.scene), to_plain(cell.conf.variant)]) for cell in plan]
    confs = {key: cell.conf for key, cell in zip(keys, plan, strict=True)}
    built = build_variants.plan([*confs.values()], store, allow_build=allow_build)
    variants = dict(zip(confs, built, strict=True))
    notes: dict[str, None] = {}
    cells = []
    for key, cell in zip(keys, plan, strict=True):
        variant = variants[key]
        cells.append(
            replace(cell, variant_id=variant.id, error=variant.error, remembered=variant.remembered)
        )
        notes |= dict.fromkeys(f"{scenes.label(cell.conf.scene)}: {n}" for n in variant.notes)
    return cells, list(notes)


def with_wanted_baselines(plan: Sequence[PlannedCell]) -> list[PlannedCell]:
    """Return the cells without the baselines that `baseline=false` leaves out.

    The baseline that a count-matched cell takes its number from stays.
    """
    references = {cell.reference for cell in plan}
    wanted = [
        cell
        for cell in plan
        if cell.conf.baseline or cell.spec.label != BASELINE or cell.spec in references
    ]
    if not wanted:
        raise XrgsError(
            "baseline=false: no cell is left to train; name an ablation (+ablation=plus)"
        )
    return wanted


def identified(cell: PlannedCell, store: Store, holders: Mapping[str, str]) -> PlannedCell:
    """Return a cell with its identity, as soon as it is known, and its current state.

    A cell that is done is not looked at again. `holders` describes the processes that train cells
    now, by the cells' ids.
    """
    if cell.variant_id is None or cell.waits or cell.state.name == "done":
        return cell
    identity = cell.identity or cell_identity(cell.conf, cell.variant_id)
    name = cell.cell_id or cell_id(identity)
    folder = store.cell(name)
    state = folder.state(owner=holders.get(name))
    trained = 0.0 if state.name == "done" else folder.steps_to_resume() / cell.conf.train.steps
    return replace(cell, identity=identity, cell_id=name, state=state, trained=trained)


def estimated(plan: Sequence[PlannedCell], past: CostEstimator, threads: int) -> list[PlannedCell]:
    """Return the cells with their expected costs, where the store has finished cells to compare.

    A cell that asks for no number of threads has `threads`.
    """
    return [
        cell
        if cell.state.name == "done"
        else replace(cell, cost=past.cost(cell.conf, cell.variant_id, cell.conf.threads or threads))
        for cell in plan
    ]


def expected_length(cell: PlannedCell) -> tuple[float, int]:
    """Return a key that sorts cells by length, the longest last.

    Cells without an estimate count as longer than all others, and are sorted by their steps.
    """
    return (float("inf") if cell.seconds is None else cell.seconds, cell.conf.train.steps)


def ready(
    plan: Sequence[PlannedCell], tried: Container[str], *, retry: bool = False
) -> dict[str, PlannedCell]:
    """Return the cells that can be trained now and are not done, by their ids.

    Those that this sweep has `tried` already are left out, and without `retry` failed ones too.
    """
    left_alone = {"done", "running"} | (set() if retry else {"failed"})
    return {
        cell.cell_id: cell
        for cell in plan
        if cell.cell_id is not None
        and cell.cell_id not in tried
        and cell.error is None
        and cell.state.name not in left_alone
    }


def describe(plan: Sequence[PlannedCell]) -> str:
    """Return the plan as text: one line per cell with its state, id, expected time and name.

    A reason that several cells share is written once.
    """
    done = sum(cell.state.name == "done" for cell in plan)
    lines = [f"plan: {counted(len(plan), 'cell')}, {done} done{_remaining(plan)}"]
    reasons = set[str]()
    for cell in plan:
        state = "failed" if cell.error else "waits" if cell.waits else cell.state.name
        reason = cell.error or cell.state.reason.partition("\n")[0]
        if reason in reasons:
            reason = "the same"
        elif reason:
            reasons.add(reason)
        cell_id = cell.cell_id or ("no count yet" if state == "waits" else "variant not built")
        to_train = not cell.error and state != "done"
        time_left = format_duration(cell.seconds) if to_train else ""
        line = f"  {state:<10} {cell_id:<18} {time_left:>8}  {cell.name}"
        lines.append(f"{line}  ({reason})" if reason else line)
    failed = any(cell.remembered or cell.state.name == "failed" for cell in plan)
    if plan[0].conf.retry != "failed" and failed:
        lines.append("failed cells are not trained again; retry=failed trains them again")
    if any(cell.not_placed for cell in plan):
        lines += TO_TRY
    if hint := build_variants.how_to_get([cell.conf.scene for cell in plan if cell.error]):
        lines.append(hint)
    return "\n".join(map(for_line, lines))


def without_kernels(plan: Sequence[PlannedCell]) -> str:
    """Return a line on how long torch takes without the kernels; empty if no cell needs torch."""
    cells = [
        cell
        for cell in left_to_train(plan)
        if cell.conf.splat.backend == "auto" and resolve_backend("auto") == "torch"
    ]
    if not cells:
        return ""
    estimates = [cell.seconds for cell in cells if cell.seconds is not None]
    torch, native = (format_duration(sum(estimates) / ratio) for ratio in (1.0, TORCH_SLOWDOWN))
    complete = len(estimates) == len(cells)
    instead = f"{torch} instead of {native}" if complete else "30 to 60 times longer"
    return (
        "the kernels were not built on this machine: torch trains"
        f" {counted(len(cells), 'cell')}, {instead}; "
        "`pip install --force-reinstall --no-deps .` builds them with a C++17 compiler or with "
        "PyPI's ziglang"
    )


def expected_use(plan: Sequence[PlannedCell], past: int) -> str:
    """Return a line on the memory and the disk that the cells will take; empty if unknown.

    The estimates are from `past` finished cells.
    """
    costs = [cell.cost for cell in left_to_train(plan) if cell.cost]
    if not costs:
        return ""
    memory, disk = max(cost.memory_bytes for cost in costs), sum(cost.disk_bytes for cost in costs)
    has = usable_memory()
    too_little = f" (more than the {format_size(has)} here)" if memory > has else ""
    return (
        f"estimates from {counted(past, 'finished cell')} of this store: a cell takes up to"
        f" ~{format_size(memory)} of memory{too_little}, all of them ~{format_size(disk)} of disk"
    )


def unchanged(plan: Sequence[PlannedCell]) -> list[str]:
    """Return a line for each label, and each condition, whose cells are those of another one.

    Each is compared with those before it; the baseline is the first label.
    """
    labels: dict[str, dict[tuple[str, ...], Any]] = {}
    for cell in plan:
        # The config of a cell that waits for a count is not complete: it is like no other.
        values = object() if cell.waits else cell.cell_id or _deciding_values(cell)
        labels.setdefault(cell.spec.label, {})[cell.spec.shared] = values
    lines = []
    for place, (label, runs) in enumerate(labels.items()):
        same = (other for other in list(labels)[:place] if labels[other].items() >= runs.items())
        if (before := next(same, None)) is not None:
            lines.append(f"{label} changes nothing here: its cells are those of {before}")
    by_condition: dict[str, dict[tuple[str, str, int, int], str | None]] = {}
    for cell in plan:
        conf = cell.conf
        run = cell.spec.label, scenes.label(conf.scene), conf.variant.seed, conf.seed
        by_condition.setdefault(cell.spec.condition, {})[run] = cell.cell_id
    first: dict[frozenset[Any], str] = {}  # the cells of a condition -> the condition
    for condition, cells in by_condition.items():
        if None in cells.values():  # until its variant is built, a cell is not known
            continue
        before = first.setdefault(frozenset(cells.items()), condition)
        if before != condition:
            lines.append(f"{condition} changes nothing here: its cells are those of {before}")
    return lines


def _deciding_values(cell: PlannedCell) -> tuple[Any, ...]:
    """Return what decides a cell's numbers while its variant is not built, and it has no id."""
    conf = cell.conf
    settings = [identity_values(group) for group in (conf.splat, conf.train, conf.components)]
    return (*settings, conf.variant, conf.scene, conf.seed)


def will_fail(plan: Sequence[PlannedCell]) -> bool:
    """Return whether a run of this plan is known to end with code 1."""
    retry = plan[0].conf.retry == "failed"
    return any(cell.error or (cell.state.name == "failed" and not retry) for cell in plan)


def left_to_train(plan: Sequence[PlannedCell]) -> list[PlannedCell]:
    """Return the cells to train, with cells that still lack their variant or count."""
    retry = plan[0].conf.retry == "failed"
    unidentified = [cell for cell in plan if cell.cell_id is None and not cell.error]
    return [*unidentified, *ready(plan, (), retry=retry).values()]


def _remaining(plan: Sequence[PlannedCell]) -> str:
    """Return the expected time of the remaining training, as far as known."""
    remaining = left_to_train(plan)
    estimates = [cell.seconds for cell in remaining if cell.seconds is not None]
    if not estimates:
        return ""
    unknown = len(remaining) - len(estimates)
    more = f" and {counted(unknown, 'cell')} without an estimate" if unknown else ""
    return f"; left to train, one after another: {format_duration(sum(estimates))}{more}"


def record(plan: Sequence[PlannedCell]) -> list[RecordedCell]:
    """Return the rows that reports are made from."""
    baselines = {cell.spec.shared: cell.cell_id for cell in plan if cell.spec.label == BASELINE}
    return [
        RecordedCell(
            cell_id=cell.cell_id,
            planned_id=_planned_id(cell),
            label=cell.spec.label,
            condition=cell.spec.condition,
            scene=scenes.label(cell.conf.scene),
            variant_seed=cell.conf.variant.seed,
            seed=cell.conf.seed,
            variant_id=cell.variant_id,
            baseline_id=baselines.get(cell.spec.shared),
            error=cell.error,
            state="not placed" if cell.not_placed else None,
        )
        for cell in plan
    ]


def _planned_id(cell: PlannedCell) -> str:
    """Return an id that exists before training.

    For most cells it is their id. The id of a count-matched cell depends on another cell's count.
    """
    if cell.cell_id is not None and cell.reference is None:
        return cell.cell_id
    conf = cell.conf
    matched = replace(conf.components.count_matched, gaussians=0)
    components = replace(conf.components, count_matched=matched)
    parts = (conf.scene, conf.variant, conf.splat, conf.train, components)
    return digest([*map(to_plain, parts), conf.seed, cell.variant_id])


def check_reference(cell: PlannedCell, reference: PlannedCell) -> None:
    """Refuse the baseline as a control, and a reference that is count-matched itself."""
    key = f"matched_to={cell.conf.matched_to}"
    if not cell.spec.changes:
        raise XrgsError(
            f"{key}: the baseline can't be matched to another cell; in the file of a sweep,"
            " matched_to belongs under hydra.sweeper.params"
        )
    if reference.conf.matched_to is not None:
        raise XrgsError(
            f"{key}: that cell is matched to {reference.conf.matched_to} itself; name an ablation"
            " that takes no count"
        )


def check_effect(combinations: Iterable[CellSpec], plan: Iterable[PlannedCell]) -> None:
    """Refuse a `matched_to` without effect, and a count-matched cell without a reference.

    `combinations` are those of the command line's axes, for which the plan is.
    """
    plan = list(plan)
    for cell in plan:
        if "matched_to=null" in cell.spec.changes:
            raise XrgsError(
                f"matched_to=null: {cell.spec.label} takes a number of Gaussians; name the ablation"
                " that it takes it from"
            )
    asked_for = {spec.matched_to: None for spec in combinations if spec.matched_to is not None}
    planned = {cell.conf.matched_to for cell in plan}
    for name in asked_for:
        if name not in planned:
            raise XrgsError(
                f"matched_to={name}: no ablation of this sweep takes a number of Gaussians; add"
                " count_matched to +ablation, or set matched_to=null"
            )


def mixed_prune_rules(plan: Sequence[PlannedCell]) -> list[str]:
    """Return a line for each label whose controls prune by another rule than their references.

    The rule (`splat.densify.prune_scale3d`) changes scores and counts more than most ablations, and
    would hide the difference that is to be measured.
    """
    cells = {cell.spec: cell for cell in plan}
    lines: dict[str, None] = {}
    for cell in plan:
        reference = cells.get(cell.reference) if cell.reference else None
        if reference is None:
            continue
        splats = [c.conf.splat for c in (cell, reference)]
        here, there = (splat.densify.prune_scale3d for splat in splats)
        if here != there and all(splat.strategy == "default" for splat in splats):
            line = (
                f"{cell.spec.label}: splat.densify.prune_scale3d is {here:g} here and {there:g} in"
                f" {reference.spec.label}, so that they differ in more than what is to be"
                " controlled for; the ablation keep_large sets it to 10"
            )
            lines[line] = None
    return list(lines)
