"""The interface of a strategy, which training calls once a step."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from types import ModuleType
from typing import Any, ClassVar

import torch
from torch import Tensor

from xrgs.splat.backend import implementation
from xrgs.splat.gaussians import PARAMETERS
from xrgs.splat.optimizer import SplatOptimizer
from xrgs.splat.settings import DensifySettings
from xrgs.splat.strategy.refinement import Groups, Refinement, StrategyHooks

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
    def _activations(self) -> ModuleType:
        """The activation functions of the optimizer's backend."""
        return implementation("activations", self.optimizer.backend)

    def _largest_scale(self) -> Tensor:
        """Return the largest scale [N] of each Gaussian, world units."""
        largest: Tensor = self._activations.exp(self.gaussians.scales.amax(dim=-1))
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
