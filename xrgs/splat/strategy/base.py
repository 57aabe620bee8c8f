"""The interface of a strategy, which training calls once a step."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from xrgs.splat.optimizer import SplatOptimizer
from xrgs.splat.settings import DensifySettings
from xrgs.splat.strategy.refinement import Groups, Refinement, StrategyHooks

NO_HOOKS = StrategyHooks()


class Strategy(ABC):
    """Decides which Gaussians there are: gsplat's `Strategy` (`strategy/base.py`).

    A strategy owns

    - the statistics of the steps since the last refinement,
    - the growth of Gaussians,
    - pruning and opacity resets,
    - the part of a checkpoint that holds all of these.

    It adds and removes Gaussians through the optimizer alone, so that Adam's moments follow.
    `DefaultStrategy` shows the loop that calls it.
    """

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
            optimizer: Holds the Gaussians.
            settings: Schedule and thresholds; `DensifySettings.scaled` fits them to the run.
            scene_scale: Extent of the scene, world units.
            generator: Draws all random numbers of the strategy.
            groups: Thresholds of groups of views; None takes the ones in `settings` for all views.
            view_pixels: Number of pixels of the largest training view, which `settings.budget` is
                multiplied by; only read where there is a budget.
        """
        self.optimizer = optimizer
        self.gaussians = optimizer.gaussians
        self.settings = settings
        self.scene_scale = scene_scale
        self.generator = generator
        self.groups = groups
        self.view_pixels = view_pixels

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
        """Take in a step's gradients and, where the schedule says so, change the Gaussians.

        Args:
            step: Number of the step, from 0. The optimizer has taken its step already.
            means2d_grad: [N, 2] gradient of the loss with respect to the projected means, per px;
                None where the step had no backward pass or its render shows no Gaussian.
            visible: [N] bool, whether the step's view shows the Gaussian.
            width: Width of the render, px.
            height: Height of the render, px.
            group: Group of the view; only read where there are groups.
            hooks: What components of training decide at this step.

        Returns:
            The counts of what was done.

        Raises:
            KeyError: There are groups, and `group` is none of them.
        """

    @abstractmethod
    def remove(self, mask: Tensor) -> int:
        """Remove Gaussians with their moments and statistics, at any step.

        Args:
            mask: [N] bool, which Gaussians.

        Returns:
            The number of Gaussians that were removed.
        """

    @abstractmethod
    def state_dict(self) -> dict[str, Any]:
        """Return what the steps so far have changed, for a checkpoint."""

    @abstractmethod
    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore a result of `state_dict`, after the optimizer has restored its Gaussians.

        Raises:
            KeyError: An entry is missing.
            ValueError: An entry does not fit the groups or the Gaussians.
        """
