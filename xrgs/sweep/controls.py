"""Checks the cells of a plan that take a number of Gaussians from another cell, its reference.

Such a cell is a control for a claim of efficiency: the baseline, or another base, with as many
Gaussians as the reference has (`xrgs.training.count_matching`).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from xrgs.errors import XrgsError

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from xrgs.sweep.axes import CellSpec
    from xrgs.sweep.plan import PlannedCell


def check_reference(cell: PlannedCell, reference: PlannedCell) -> None:
    """Refuse a control whose count can't be known.

    Args:
        cell: A cell that takes a count.
        reference: The cell that it takes it from.

    Raises:
        XrgsError: The control is the baseline itself, which every cell is compared with; or its
            reference takes a count as well.
    """
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
    """Refuse a `matched_to` of the command line that nothing is matched to.

    Args:
        combinations: The combinations of the command line's axes, with `matched_to`.
        plan: The cells that are planned for them.

    Raises:
        XrgsError: No planned cell takes its count from the cell that is named, or a planned cell
            takes one and is given none.
    """
    plan = list(plan)
    for cell in plan:
        if "matched_to=null" in cell.spec.changes:
            raise XrgsError(
                f"matched_to=null: {cell.spec.label} takes a number of Gaussians; name the ablation"
                " that it takes it from"
            )
    wanted = {spec.matched_to: None for spec in combinations if spec.matched_to is not None}
    found = {cell.conf.matched_to for cell in plan}
    for name in wanted:
        if name not in found:
            raise XrgsError(
                f"matched_to={name}: no ablation of this sweep takes a number of Gaussians; add"
                " count_matched to +ablation, or set matched_to=null"
            )


def mixed_prune_rules(plan: Sequence[PlannedCell]) -> list[str]:
    """Return a line for each kind of control whose rule against large Gaussians is another one.

    The rule (`splat.densify.prune_scale3d`) changes scores and counts more than most ablations do,
    so that a difference between the two cells can't be laid to anything else.

    Args:
        plan: All cells.

    Returns:
        The lines, without those of further scenes, replicates and conditions.
    """
    cells = {cell.spec: cell for cell in plan}
    lines: dict[str, None] = {}
    for cell in plan:
        reference = cells.get(cell.reference) if cell.reference else None
        if reference is None:
            continue
        own, other = (c.conf.splat.densify.prune_scale3d for c in (cell, reference))
        if own != other:
            line = (
                f"{cell.spec.label}: splat.densify.prune_scale3d is {own:g} here and {other:g} in"
                f" {reference.spec.label}, so that they differ in more than what is to be"
                " controlled for; the ablation keep_large sets it to 10"
            )
            lines[line] = None
    return list(lines)
