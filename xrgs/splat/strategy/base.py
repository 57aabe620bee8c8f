"""The interface of a strategy, which training calls once a step: inputs, hooks and result."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from types import ModuleType
from typing import Any, ClassVar

import torch
from torch import Tensor

from xrgs.splat.backend import implementation
from xrgs.splat.gaussians import PARAMETERS, Gaussians
from xrgs.splat.optimizer import SplatOptimizer
from xrgs.splat.settings import DECIDE, DensifySettings

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


NO_HOOKS = StrategyHooks()


class Strategy(ABC):
    """Adds, removes and changes Gaussians between steps: gsplat's `Strategy` (`strategy/base.py`).

    It changes Gaussians only through the optimizer, so that Adam's moments follow. The example of
    `DefaultStrategy` is the training loop around it.

    Attributes:
        asks_components: Whether training components influence growth: by `groups`,
            `StrategyHooks.may_grow` and `StrategyHooks.growth_scores`.
    """

    asks_components: ClassVar[bool] = True

    def __init__(
        self,
        optimizer: SplatOptimizer,
        settings: DensifySettings,
        *,
        scene_scale: float,
        generator: torch.Generator,
        groups: Groups | None = None,
        view_pixels: int = 0,
    ) -> None:
        """Start before the first step.

        Args:
            optimizer: Optimizer of the Gaussians.
            settings: Schedule and thresholds, already scaled to the run (`DensifySettings.scaled`).
            scene_scale: Extent of the scene, world units.
            generator: Draws all random numbers of the strategy.
            groups: Thresholds for each group of views; None applies those of `settings` to all.
            view_pixels: Number of pixels of the largest training view; only read with a
                `settings.budget`, which is per pixel.

        Raises:
            ValueError: The strategy does not support `groups`, or needs a budget.
        """
        self.optimizer = optimizer
        self.gaussians = optimizer.gaussians
        self.settings = settings
        self.scene_scale = scene_scale
        self.generator = generator
        self.groups = groups
        self.view_pixels = view_pixels
        self._begin()

    @abstractmethod
    def _begin(self) -> None:
        """Initialise the attributes of the subclass, after those of this class."""

    @abstractmethod
    def after_step(
        self,
        step: int,
        means2d_grad: Tensor | None,
        visible: Tensor,
        *,
        width: int,
        height: int,
        group: str = "",
        hooks: StrategyHooks = NO_HOOKS,
    ) -> Refinement:
        """Add a step's gradients to the statistics and, if it is due, refine the Gaussians.

        Args:
            step: Number of the step, from 0. The optimizer has taken its step already.
            means2d_grad: [N, 2] gradient of the loss with respect to the projected means, per px;
                None if the step had no backward pass or its render shows no Gaussian.
            visible: [N] bool, whether the step's view shows the Gaussian.
            width: Width of the render, px.
            height: Height of the render, px.
            group: Group of the view; only read if there are groups.
            hooks: Decisions of the training components; ignored unless `asks_components`.

        Returns:
            The numbers of changed Gaussians.

        Raises:
            KeyError: There are groups, and `group` is none of them.
        """

    @abstractmethod
    def remove(self, mask: Tensor) -> int:
        """Remove the Gaussians of `mask` [N] with moments and statistics; return their number."""

    @abstractmethod
    def state_dict(self) -> dict[str, Any]:
        """Return the strategy's state for a checkpoint."""

    @abstractmethod
    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore a state of `state_dict`, after the optimizer has restored its Gaussians.

        Raises:
            KeyError: An entry is missing.
            ValueError: An entry does not fit the groups or the Gaussians.
        """

    @property
    def _elementwise(self) -> ModuleType:
        """The activation functions and statistics of the optimizer's backend."""
        return implementation("elementwise", self.optimizer.backend)

    def _largest_scale(self) -> Tensor:
        """Return the largest scale [N] of each Gaussian, world units."""
        largest: Tensor = self._elementwise.exp(self.gaussians.scales.amax(dim=-1))
        return largest

    def _finite(self) -> Tensor:
        """Return for which Gaussians [N] all parameters and the largest scale are finite."""
        finite = torch.isfinite(self._largest_scale())  # [N]
        for name in PARAMETERS:
            # 0 * x is 0 only for finite x; `isfinite` and `all` take ten times as long.
            finite &= (0 * self.gaussians[name].detach()[..., None]).flatten(1).sum(dim=1) == 0
        return finite

    def _keep(self, mask: Tensor) -> None:
        """Keep the Gaussians of `mask` [N] and remove all others."""
        if not mask.all():  # else nothing needs to be copied
            self.optimizer.keep(mask)
