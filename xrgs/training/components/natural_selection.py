"""Fewer Gaussians after densification, by a push on all opacities [deng2025gns]."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Self

import torch
from torch import Tensor

from xrgs.errors import XrgsError
from xrgs.splat.rounding import rounded_mean
from xrgs.splat.settings import NOMINAL_STEPS
from xrgs.splat.strategy.ops import gaussians_of
from xrgs.training.components.base import Component, Step, TrainingSetup, check_not_negative

if TYPE_CHECKING:
    from xrgs.config import NaturalSelectionConf
    from xrgs.splat.gaussians import Gaussians

_LOWEST_LIVE_LOGIT = math.log(0.001 / 0.999)
"""Gaussians with an opacity below 0.001 are removed [deng2025gns]."""
_ADJUST_EVERY = 100
"""Steps of a 30,000-step run between two adjustments of the push [deng2025gns]."""
_LEAD = 1_000
"""Steps of a 30,000-step run by which the path of the opacities ends early [deng2025gns]."""
_START, _TOLERANCE, _LESS, _MORE = 0.8, 0.1, 0.8, 1.2
"""The path starts at this share of the opacity; outside this tolerance around the path the push is
multiplied by one of the factors [deng2025gns]."""
_CLOSE = 1.05
"""From this many times the budget on, the rest is removed at once [deng2025gns]."""


class NaturalSelection(Component):
    """Lowers all opacities alike after densification, and removes the Gaussians that fade.

    Gradient-driven natural selection [deng2025gns]. From the end of densification on, the gradient
    of every logit opacity has the same constant g added,

        d L / d logit_i  +  g,

    so that a Gaussian keeps its opacity where the photographs resist with a gradient of their own,
    and fades where they do not. Gaussians with an opacity below 0.001 are removed, the most
    transparent first, until the budget is met. Within 5% of the budget, or at step `until`, the
    most transparent Gaussians beyond the budget are removed at once, and training goes on without
    the push.

    g follows a path, as in the authors' code. With B the budget, the opacity of the B-th most
    opaque Gaussian, the last one to keep, shall fall linearly from 0.8 of its first value to 0, and
    reach 0 at 1,000 steps of 30,000 before `until`. Every 100 such steps g is multiplied by 0.8 if
    that opacity is more than 10% below the path, and by 1.2 if it is more than 10% above it.

    Ours, where the authors' code differs:

    - g begins as the mean absolute gradient of the logit opacities in the first step, so that no
      unit of the image or the scene has to be tuned to. The authors' g is the gradient of a
      quadratic term with a weight of 2e-4.
    - g is added at every step, not at every 50th with four times the learning rate. Adam divides by
      the root of the second moment. If a Gaussian's own gradients are small beside g, a constant is
      worth a full step of the learning rate, 0.05 of logit: enough for 13 units of logit in 270
      steps. A pulse at every 50th step would be worth a seventh of that.
    - Opaque Gaussians are not pushed harder in the first 1,000 steps.

    The budget is in Gaussians for each pixel of the largest training view, like
    `splat.densify.budget`. If densification left no more Gaussians, nothing happens.
    """

    def __init__(self, settings: NaturalSelectionConf, budget: int, stop: int) -> None:
        """Take the schedule.

        Args:
            settings: `components.natural_selection` of the config.
            budget: The number of Gaussians to keep.
            stop: Step of a 30,000-step run at which densification ends.
        """
        self.budget, self.start, self.until = budget, stop, settings.until
        self.drop_every = settings.drop_every
        self.push = 0.0
        """g, in units of the gradient; 0 before the first step of the selection."""
        self.first_opacity = 0.0
        """Where the path starts: a share of the opacity of the last Gaussian to keep."""
        self.done = False
        """Whether the budget has been met."""

    @classmethod
    def from_settings(cls, settings: NaturalSelectionConf, setup: TrainingSetup) -> Self | None:
        """Build the component; a `budget` of 0 leaves it off.

        Raises:
            XrgsError: The budget is below 0, `drop_every` below 1, or the selection would end
                before densification does or after the run.
        """
        check_not_negative("components.natural_selection.budget", settings.budget)
        if settings.budget == 0:
            return None
        if settings.drop_every < 1:
            raise XrgsError(
                f"components.natural_selection.drop_every={settings.drop_every}: must be at least 1"
            )
        stop = setup.splat.densify.stop
        if not stop + _LEAD < settings.until <= NOMINAL_STEPS:
            raise XrgsError(
                f"components.natural_selection.until={settings.until}: must be above"
                f" splat.densify.stop + {_LEAD} = {stop + _LEAD} and at most {NOMINAL_STEPS}"
            )
        return cls(settings, gaussians_of(settings.budget, setup.data.view_pixels), stop)

    def after_backward(self, gaussians: Gaussians, step: Step) -> None:
        """Add the push to the gradient of the logit opacities.

        `natural_selection.push` records it, in units of the gradient.
        """
        gradient = gaussians.opacities.grad
        if self.done or step.nominal < self.start or gradient is None:
            return
        if len(gaussians) <= self.budget:
            self.done = True
            return
        if self.push == 0:
            self.push = rounded_mean(gradient.abs())
            self.first_opacity = _START * self._last_survivors_opacity(gaussians)
        elif _is_due(step, _ADJUST_EVERY):
            last = self._last_survivors_opacity(gaussians)
            goal = self.first_opacity * self._share_left(step)
            if last < (1 - _TOLERANCE) * goal:
                self.push *= _LESS
            elif last > (1 + _TOLERANCE) * goal:
                self.push *= _MORE
        gradient += self.push
        step.log["natural_selection.push"] = self.push

    def to_prune(self, gaussians: Gaussians, step: Step) -> Tensor | None:
        """Return which Gaussians [N] have faded, or at the end of the selection the excess."""
        excess = len(gaussians) - self.budget
        if self.done or step.nominal < self.start or excess <= 0:
            return None
        self.done = step.nominal >= self.until or len(gaussians) <= _CLOSE * self.budget
        if not (self.done or _is_due(step, self.drop_every)):
            return None
        logits = gaussians.opacities.detach()
        lowest = torch.zeros_like(logits, dtype=torch.bool)
        lowest[torch.argsort(logits, stable=True)[:excess]] = True
        return lowest if self.done else lowest & (logits < _LOWEST_LIVE_LOGIT)

    def state_dict(self) -> dict[str, Any]:
        """Return the push, the start of the path, and whether the budget has been met."""
        return {"push": self.push, "first_opacity": self.first_opacity, "done": self.done}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore what `state_dict` returned."""
        self.push, self.first_opacity = float(state["push"]), float(state["first_opacity"])
        self.done = bool(state["done"])

    def _last_survivors_opacity(self, gaussians: Gaussians) -> float:
        """The opacity of the last Gaussian to keep."""
        rank = len(gaussians) - self.budget + 1  # from the most transparent one, 1
        logit = gaussians.opacities.detach().kthvalue(rank).values.item()
        return 1 / (1 + math.exp(-logit))

    def _share_left(self, step: Step) -> float:
        """The share of the path's first opacity that is left at a step."""
        done = (step.nominal - self.start) / (self.until - _LEAD - self.start)
        return max(0.0, 1 - done)


def _is_due(step: Step, every: int) -> bool:
    """Whether the step is the first one in a period of `every` nominal steps."""
    return step.nominal // every != (step.number - 1) * NOMINAL_STEPS / step.total // every
