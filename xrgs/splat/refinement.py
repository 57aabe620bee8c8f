"""What densification is told at a step, and what it reports of it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

from torch import Tensor

from xrgs.splat.gaussians import Gaussians

DECIDE = ("current_view", "per_class", "own_threshold")
"""The values of `Groups.decide`."""

_OPTIONAL = "pruned_by_components"


@dataclass(frozen=True)
class Refinement:
    """What a step's densification did; all counts are 0 at most steps.

    Each Gaussian removed is counted once, by the first rule that holds in the order below, so that
    the number of Gaussians grows by exactly `duplicated + split - removed`.
    """

    duplicated: int = 0
    """Small Gaussians with a high gradient, each of which a copy was added of."""
    split: int = 0
    """Gaussians with a high gradient, each of which was replaced by two: the large ones, or with
    `split=long_axis` all that grow."""
    pruned_non_finite: int = 0
    """Gaussians with a parameter, or the exponential of a scale, that was infinite or NaN."""
    pruned_opacity: int = 0
    """Gaussians with an opacity below the threshold."""
    pruned_scale: int = 0
    """Gaussians that were too large, with an opacity that was high enough."""
    pruned_by_components: int = 0
    """Gaussians that components of training had removed (`Densifier.remove`)."""
    reset: int = 0
    """Gaussians whose opacity was lowered to the cap."""
    by_group: Mapping[str, int] = field(default_factory=dict)
    """Counts for each group of views, where there are groups. `grown_<group>`: Gaussians above the
    group's growth threshold; one above the thresholds of two groups counts in both.
    `pruned_opacity_<group>`: Gaussians below its opacity threshold."""

    @property
    def removed(self) -> int:
        """Number of Gaussians pruned; those that a split replaced are not among them."""
        rules = self.pruned_non_finite + self.pruned_opacity + self.pruned_scale
        return rules + self.pruned_by_components

    def counts(self) -> dict[str, int]:
        """Return the counts by name: those of the rules, then those of the groups.

        `pruned_by_components` is there where it is not 0, so that no other run has a column of it.
        """
        left_out = {"by_group"} if self.pruned_by_components else {"by_group", _OPTIONAL}
        rules = {name: value for name, value in vars(self).items() if name not in left_out}
        return rules | dict(self.by_group)


@dataclass(frozen=True)
class Thresholds:
    """The two thresholds that groups of views may have of their own."""

    grow_grad2d: float
    """A Gaussian grows if its mean image-plane gradient is above this (`DensifySettings`)."""
    prune_opacity: float
    """A Gaussian is pruned if its opacity is below this."""


@dataclass(frozen=True)
class Groups:
    """Groups of views with thresholds of their own.

    `decide` says which of them hold:

    - `current_view`: all views add to one statistic, and the group of the view at whose step
      Gaussians are refined sets both thresholds.
    - `per_class`: each group has statistics of its own. A Gaussian grows where any group's mean
      gradient is above that group's threshold. It is pruned by the threshold of one group: the
      first, in the order given, in a view of which it had an image-plane gradient since the last
      refinement (being in the view's frustum is not enough: in a forward-facing scene every
      Gaussian is in every frustum), or the last group if it had none in any view.
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
class DensifierHooks:
    """What others decide at a step; each is asked with the N Gaussians, and None changes nothing.

    All but `opacity_attenuation` are asked at refinements alone, with the Gaussians as the step's
    optimizer has left them, and with gradients switched off.
    """

    may_grow: Callable[[Gaussians], Tensor | None] = _nothing
    """Returns [N] bool, which of the Gaussians above the growth threshold may grow."""
    growth_scores: Callable[[Gaussians], Tensor | None] = _nothing
    """Returns scores [N] of at least 0. It is asked where a budget leaves room for some of the
    Gaussians that would grow; those of the highest score do, None standing for the mean
    image-plane gradient."""
    opacity_attenuation: Callable[[Gaussians], Tensor | None] = _nothing
    """Returns the factors [N] in 0..1 by which every render lowers the opacities. A reset, which
    asks after the step's refinement, caps the lowered opacities."""
