"""Steps without a backward pass on views whose loss has stopped falling [li2026skipgs]."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Self

from torch import Tensor

from xrgs.errors import XrgsError
from xrgs.training.components import Component, Step, TrainingSetup, check_not_negative


@dataclass
class Settings:
    """The keys under `components.plugins.skip_backward` of the config."""

    share: float = 1.0
    """The least share of steps with a backward pass, from `begin` on; 1 is off."""
    tolerance: float = 0.0
    """A step may be skipped if its loss is at most this far above the view's mean, relative."""
    decay: float = 0.95
    """The decay of the running mean of a view's loss, per step on the view; SkipGS's value."""
    begin: int = 15_000
    """The step of a 30,000-step run from which on steps may be skipped: densification's end."""


class SkipBackward(Component):
    """Skips the backward pass of a step if its view's loss is not above its running mean.

    SkipGS [li2026skipgs] renders every step. After densification has stopped it skips the backward
    pass and the optimizer's step if the view's loss is consistent with its recent values, as long
    as a given share of the steps has a backward pass. Let L be the loss of a step on view v, n the
    number of steps since `begin`, including this one, and b the number of backward passes since
    `begin`. The step is skipped if

        L <= (1 + tolerance) mean_v    and    b >= share n

    Afterwards, skipped or not, mean_v = decay mean_v + (1 - decay) L. The first step on a view is
    never skipped, and sets mean_v = L. A loss that is not finite does not change the mean.

    From the documentation of the authors' code: the decay of 0.95, the tolerance of 0, and that
    only a high loss forces a backward pass. Our choice: `share` is a setting, which the authors
    derive from a period without skipping; there is no such period here; and L has all terms and
    weights of the other components. In a short training the loss of a view falls from step to step,
    so it is below its mean, and only `share` decides how many steps are skipped.
    """

    settings_type = Settings

    def __init__(self, settings: Settings) -> None:
        """Start without any mean."""
        self.settings = settings
        self.means: dict[str, float] = {}
        self.steps = 0
        self.backward_passes = 0

    @classmethod
    def from_settings(cls, settings: Settings, setup: TrainingSetup) -> Self | None:
        """Build the component; a `share` of 1 leaves it off.

        Raises:
            XrgsError: A setting is out of its range.
        """
        del setup
        key = "components.plugins.skip_backward"
        for name in ("tolerance", "begin"):
            check_not_negative(f"{key}.{name}", getattr(settings, name))
        if not 0 <= settings.share <= 1:
            raise XrgsError(f"{key}.share={settings.share}: must be from 0 to 1")
        if not 0 <= settings.decay < 1:
            raise XrgsError(f"{key}.decay={settings.decay}: must be 0 or more and below 1")
        return None if settings.share == 1 else cls(settings)

    def needs_backward(self, loss: Tensor, step: Step) -> bool:
        """Compare the loss with the view's mean, and update the mean.

        From `begin` on, `skip_backward.<tag>` records 1 for a skipped step and 0 for any other, so
        that a row of the history has the share of skipped steps.
        """
        if step.nominal < self.settings.begin:
            return True
        value, name, decay = loss.item(), step.view.name, self.settings.decay
        mean = self.means.get(name, -math.inf)
        fits = value <= (1 + self.settings.tolerance) * mean
        self.steps += 1
        skips = fits and self.backward_passes >= self.settings.share * self.steps
        self.backward_passes += not skips
        if math.isfinite(value):
            self.means[name] = decay * mean + (1 - decay) * value if name in self.means else value
        step.log[f"skip_backward.{step.view.tag}"] = float(skips)
        return not skips

    def state_dict(self) -> dict[str, Any]:
        """Return the running means by view, and the counts of steps and backward passes."""
        return {
            "means": self.means,
            "steps": self.steps,
            "backward_passes": self.backward_passes,
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore what `state_dict` returned."""
        self.means = {name: float(mean) for name, mean in state["means"].items()}
        self.steps = int(state["steps"])
        self.backward_passes = int(state["backward_passes"])
