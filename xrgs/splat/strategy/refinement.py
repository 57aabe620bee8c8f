"""The inputs of a strategy at a step (groups, hooks), and its result (`Refinement`)."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from torch import Tensor

    from xrgs.splat.gaussians import Gaussians

DECIDE = ("current_view", "per_class", "own_threshold")
"""Allowed values of `Groups.decide`."""

_OPTIONAL = ("pruned_by_components", "relocated", "added")


@dataclass(frozen=True)
class Refinement:
    """Counts of the Gaussians that a strategy changed after a step; 0 at most steps.

    A removed Gaussian is counted once, by the first rule below that applies. So the number of
    Gaussians grows by exactly `duplicated + split + added - removed`.
    """

    duplicated: int = 0
    """Small Gaussians with a high gradient that were copied."""
    split: int = 0
    """Gaussians with a high gradient that were replaced by two: the large ones, or with
    `split=long_axis` all that grow."""
    pruned_non_finite: int = 0
    """Gaussians with a parameter or scale that was infinite or NaN."""
    pruned_opacity: int = 0
    """Gaussians with an opacity below the threshold."""
    pruned_scale: int = 0
    """Gaussians that were too large; those with a low opacity are counted above."""
    pruned_by_components: int = 0
    """Gaussians that training components pruned (`Component.to_prune`)."""
    reset: int = 0
    """Gaussians whose opacity was lowered to the cap."""
    relocated: int = 0
    """Transparent Gaussians that were moved to others (`MCMCStrategy`)."""
    added: int = 0
    """Added copies of Gaussians (`MCMCStrategy`)."""
    by_group: Mapping[str, int] = field(default_factory=dict)
    """Counts for each group of views, if there are groups. `grown_<group>`: Gaussians above the
    group's growth threshold; a Gaussian above the thresholds of two groups counts in both.
    `pruned_opacity_<group>`: Gaussians below the group's opacity threshold."""

    @property
    def removed(self) -> int:
        """Number of pruned Gaussians, without those that a split replaced."""
        rules = self.pruned_non_finite + self.pruned_opacity + self.pruned_scale
        return rules + self.pruned_by_components

    def counts(self) -> dict[str, int]:
        """Return name -> count, first of the rules, then of the groups."""
        # Optional counts only if not 0: most runs need no column for them.
        rules = {
            name: value
            for name, value in vars(self).items()
            if name != "by_group" and (value or name not in _OPTIONAL)
        }
        return rules | dict(self.by_group)


@dataclass(frozen=True)
class Thresholds:
    """The two thresholds that each group of views may have."""

    grow_grad2d: float
    """A Gaussian grows if its mean image-plane gradient is above this (`DensifySettings`)."""
    prune_opacity: float
    """A Gaussian is pruned if its opacity is below this."""


@dataclass(frozen=True)
class Groups:
    """Groups of views, each with its own thresholds.

    `decide` selects the thresholds at a refinement:

    - `current_view`: all views share one statistic. Both thresholds are those of the group whose
      view is trained at the step of the refinement.
    - `per_class`: each group has its own statistics. A Gaussian grows if the mean gradient of any
      group is above that group's threshold. The opacity threshold is that of the first group, in
      the given order, with an image-plane gradient for the Gaussian since the last refinement, else
      that of the last group. (Being inside a view's frustum does not count: in a forward-facing
      scene every Gaussian is inside every frustum.)
    - `own_threshold`: the gradients of each view are divided by the threshold of its group. A
      Gaussian grows if their mean over all views is above 1. It is pruned as with `per_class`.

    Raises:
        ValueError: `decide` is none of these.
    """

    thresholds: Mapping[str, Thresholds]
    decide: str

    def __post_init__(self) -> None:
        if self.decide not in DECIDE:
            raise ValueError(f"decide={self.decide}: must be one of {', '.join(DECIDE)}")


def _nothing(gaussians: Gaussians) -> None:
    """A hook that changes nothing."""
    del gaussians


@dataclass(frozen=True)
class StrategyHooks:
    """Functions by which training components influence a strategy.

    Each takes the N Gaussians; a result of None changes nothing. A strategy calls `may_grow` and
    `growth_scores` only at refinements, before it changes anything, and without gradients.
    """

    may_grow: Callable[[Gaussians], Tensor | None] = _nothing
    """Returns [N] bool, whether the Gaussian may grow if it is above the growth threshold."""
    growth_scores: Callable[[Gaussians], Tensor | None] = _nothing
    """Returns scores [N], at least 0. If a budget has room for only some of the growing Gaussians,
    those with the highest scores grow; None takes the mean image-plane gradient as the score."""
    opacity_attenuation: Callable[[Gaussians], Tensor | None] = _nothing
    """Returns factors [N] in 0..1 by which every render multiplies the opacities. A reset, which
    comes after the step's refinement, caps the multiplied opacities."""
