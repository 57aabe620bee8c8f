"""Checks the count-matched cells of a plan.

A count-matched cell is a control for a claim of efficiency: it has as many Gaussians as another
cell, its reference (`xrgs.training.count_matching`).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from xrgs.errors import XrgsError

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from xrgs.sweep.axes import CellSpec
    from xrgs.sweep.plan import PlannedCell


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
