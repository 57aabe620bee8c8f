"""Fewer Gaussians after densification, by a constant gradient on all opacities [deng2025gns]."""

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
from xrgs.training.components.base import Component, Step, TrainingSetup

if TYPE_CHECKING:
    from xrgs.config import NaturalSelectionConf
    from xrgs.splat.gaussians import Gaussians

_LOWEST_LIVE_LOGIT = math.log(0.001 / 0.999)
"""Gaussians with a lower logit, an opacity below 0.001, are removed [deng2025gns]."""
_ADJUST_EVERY = 100
"""Steps of a 30,000-step run between two adjustments of g [deng2025gns]."""
_LEAD = 1_000
"""Steps of a 30,000-step run from the end of the opacity's path to `until` [deng2025gns]."""
_START, _TOLERANCE, _LESS, _MORE = 0.8, 0.1, 0.8, 1.2
"""Start of the path, as a fraction of the opacity; tolerance around the path; factors of g below
and above it [deng2025gns]."""
_CLOSE = 1.05
"""At or below this multiple of the budget, the excess is removed at once [deng2025gns]."""


class NaturalSelection(Component):
    """Lowers all opacities after densification, and removes the Gaussians that fade.

    Gradient-driven natural selection [deng2025gns]. From the end of densification on, the same
    constant g, the push, is added to the gradient of every logit opacity,

        d L / d logit_i  +  g,

    so that a Gaussian keeps its opacity where the gradient of the loss resists, and fades where it
    does not. Gaussians with an opacity below 0.001 are removed, the most transparent first, until
    the budget is met. Within 5% of the budget, or at step `until`, the most transparent Gaussians
    beyond the budget are removed at once, and training continues without g.

    g is adjusted so that an opacity follows a path, as in the authors' code. With budget B, the
    opacity of the B-th most opaque Gaussian, the last one to keep, is to fall linearly from 0.8 of
    its first value to 0 at 1,000 steps before `until`. Every 100 steps g is multiplied by 0.8 if
    that opacity is more than 10% below the path, and by 1.2 if it is more than 10% above it. Steps
    are those of a 30,000-step run.

    Differences from the authors' code:

    - g starts as the mean absolute gradient of the logit opacities in the first step, and so needs
      no tuning to the image or the scene. The authors' g is the gradient of a quadratic term with a
      weight of 2e-4.
    - g is added at every step. The authors add it at every 50th step, at four times the learning
      rate. Adam divides by the root of the second moment: if a Gaussian's other gradients are small
      compared with g, a constant g moves a logit by the learning rate of 0.05 at each step, or 13
      in 270 steps; a pulse at every 50th step moves it by a seventh of that.
    - Opaque Gaussians get no larger g in the first 1,000 steps.

    The budget is per pixel of the largest training view, like `splat.densify.budget`. If
    densification ends within the budget, the component changes nothing.
    """

    def __init__(self, settings: NaturalSelectionConf, budget: int, stop: int) -> None:
        """Keep `budget` Gaussians, from step `stop` of a 30,000-step run on."""
        self.budget, self.start, self.until = budget, stop, settings.until
        self.drop_every = settings.drop_every
        self.push = 0.0
        """g, in units of the gradient; 0 before the first step of the selection."""
        self.first_opacity = 0.0
        """Start of the path: a fraction of the opacity of the last Gaussian to keep."""
        self.done = False
        """Whether the budget has been met."""

    @classmethod
    def from_settings(cls, settings: NaturalSelectionConf, setup: TrainingSetup) -> Self | None:
        """Build the component; a `budget` of 0 leaves it off.

        Raises:
            XrgsError: `until` is before the end of densification plus 1,000 steps, or after the
                run.
        """
        if settings.budget == 0:
            return None
        stop = setup.splat.densify.stop
        if not stop + _LEAD < settings.until <= NOMINAL_STEPS:
            raise XrgsError(
                f"components.natural_selection.until={settings.until}: must be above"
                f" splat.densify.stop + {_LEAD} = {stop + _LEAD} and at most {NOMINAL_STEPS}"
            )
        return cls(settings, gaussians_of(settings.budget, setup.data.view_pixels), stop)

    def after_backward(self, gaussians: Gaussians, step: Step) -> None:
        """Add the push to the gradient of the logit opacities.

        `natural_selection.push` records the push, in units of the gradient.
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
            passed = (step.nominal - self.start) / (self.until - _LEAD - self.start)
            goal = self.first_opacity * max(0.0, 1 - passed)
            if last < (1 - _TOLERANCE) * goal:
                self.push *= _LESS
            elif last > (1 + _TOLERANCE) * goal:
                self.push *= _MORE
        gradient += self.push
        step.log["natural_selection.push"] = self.push

    def to_prune(self, gaussians: Gaussians, step: Step) -> Tensor | None:
        """Return the faded Gaussians [N]; at the end of the selection, those beyond the budget."""
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
        """Restore a state of `state_dict`."""
        self.push, self.first_opacity = float(state["push"]), float(state["first_opacity"])
        self.done = bool(state["done"])

    def _last_survivors_opacity(self, gaussians: Gaussians) -> float:
        """Return the opacity of the last Gaussian to keep."""
        rank = len(gaussians) - self.budget + 1  # from the most transparent one, 1
        logit = gaussians.opacities.detach().kthvalue(rank).values.item()
        return 1 / (1 + math.exp(-logit))


def _is_due(step: Step, every: int) -> bool:
    """Return whether a step is the first one in a period of `every` steps of a 30,000-step run."""
    return step.nominal // every != (step.number - 1) * NOMINAL_STEPS / step.total // every
