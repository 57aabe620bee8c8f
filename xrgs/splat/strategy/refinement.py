"""What a strategy is told at a step, and what it reports."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from torch import Tensor

    from xrgs.splat.gaussians import Gaussians

DECIDE = ("current_view", "per_class", "own_threshold")
"""The values of `Groups.decide`."""

_OPTIONAL = ("pruned_by_components", "relocated", "added")


@dataclass(frozen=True)
class Refinement:
    """What a strategy did after a step; all counts are 0 at most steps.

    A removed Gaussian is counted once, by the first rule that holds in the order below. So the
    number of Gaussians grows by exactly `duplicated + split + added - removed`.
    """

    duplicated: int = 0
    """Small Gaussians with a high gradient that were copied."""
    split: int = 0
    """Gaussians with a high gradient that were replaced by two: the large ones, or with
    `split=long_axis` all that grow."""
    pruned_non_finite: int = 0
    """Gaussians with a parameter, or the exponential of a scale, that was infinite or NaN."""
    pruned_opacity: int = 0
    """Gaussians with an opacity below the threshold."""
    pruned_scale: int = 0
    """Gaussians that were too large, with an opacity that was high enough."""
    pruned_by_components: int = 0
    """Gaussians that components of training chose (`Component.to_prune`)."""
    reset: int = 0
    """Gaussians whose opacity was lowered to the cap."""
    relocated: int = 0
    """Transparent Gaussians that were moved to others (`MCMCStrategy`)."""
    added: int = 0
    """Gaussians that were added at others (`MCMCStrategy`)."""
    by_group: Mapping[str, int] = field(default_factory=dict)
    """Counts for each group of views, where there are groups. `grown_<group>`: Gaussians above the
    group's growth threshold; one above the thresholds of two groups counts in both.
    `pruned_opacity_<group>`: Gaussians below its opacity threshold."""

    @property
    def removed(self) -> int:
        """Number of pruned Gaussians, without the ones that a split replaced."""
        rules = self.pruned_non_finite + self.pruned_opacity + self.pruned_scale
        return rules + self.pruned_by_components

    def counts(self) -> dict[str, int]:
        """Return the counts of the rules by their names, then the counts of the groups."""
        # Some only where they are not 0: other runs have no column for them.
        rules = {
            name: value
            for name, value in vars(self).items()
            if name != "by_group" and (value or name not in _OPTIONAL)
        }
        return rules | dict(self.by_group)


@dataclass(frozen=True)
class Thresholds:
    """The two thresholds that may differ between groups of views."""

    grow_grad2d: float
    """A Gaussian grows if its mean image-plane gradient is above this (`DensifySettings`)."""
    prune_opacity: float
    """A Gaussian is pruned if its opacity is below this."""


@dataclass(frozen=True)
class Groups:
    """Groups of views with thresholds of their own.

    `decide` says which thresholds hold at a refinement:

    - `current_view`: all views add to one statistic, and the group of the view at whose step
      Gaussians are refined sets both thresholds.
    - `per_class`: each group has statistics of its own. A Gaussian grows where any group's mean
      gradient is above that group's threshold. It is pruned by the threshold of the first group,
      in the order given, with a view in which the Gaussian had an image-plane gradient since the
      last refinement, or of the last group if there is no such view. (To be in a view's frustum is
      not enough: in a forward-facing scene every Gaussian is in every frustum.)
    - `own_threshold`: a Gaussian grows where the mean over all views of its gradient, each divided
      by the threshold of the view's own group, is above 1. It is pruned as with `per_class`.

    Raises:
        ValueError: `decide` is none of these.
    """

    thresholds: Mapping[str, Thresholds]
    decide: str

    def __post_init__(self) -> None:
        if self.decide not in DECIDE:
            raise ValueError(f"decide={self.decide}: must be one of {', '.join(DECIDE)}")


def _nothing(gaussians: Gaussians) -> None:
    """The answer of a hook that changes nothing."""
    del gaussians


@dataclass(frozen=True)
class StrategyHooks:
    """What components of training decide; a hook takes the N Gaussians, None changes nothing.

    A strategy calls `may_grow` and `growth_scores` at refinements alone, before it changes
    anything, and without gradients.
    """

    may_grow: Callable[[Gaussians], Tensor | None] = _nothing
    """Returns [N] bool, which of the Gaussians above the growth threshold may grow."""
    growth_scores: Callable[[Gaussians], Tensor | None] = _nothing
    """Returns scores [N] of at least 0, by which the Gaussians that grow are chosen where a budget
    leaves room for some of them; None stands for the mean image-plane gradient."""
    opacity_attenuation: Callable[[Gaussians], Tensor | None] = _nothing
    """Returns the factors [N] in 0..1 by which every render lowers the opacities. A reset caps the
    lowered opacities; it comes after the step's refinement."""
