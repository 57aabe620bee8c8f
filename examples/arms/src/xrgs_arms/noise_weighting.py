"""A weight of each LR view in the loss, which falls with the view's residual."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Self

import torch
from torch import Tensor

from xrgs.errors import XrgsError
from xrgs.splat.resample import resize
from xrgs.splat.rounding import rounded_mean
from xrgs.training.components import (
    Component,
    Step,
    TrainingSetup,
    TrainingView,
    check_not_negative,
)

if TYPE_CHECKING:
    from xrgs.splat.gaussians import Gaussians


_LEAST_RATE = 0.1
"""The least weight of a new value in a running mean, so that the mean covers about the last ten
steps on a view; our choice."""


@dataclass
class Settings:
    """The keys under `components.plugins.noise_weighting` of the config."""

    floor: float = 1.0
    """The lowest weight of an LR view; 1 is off."""
    begin: int = 15_000
    """The step of a 30,000-step run from which on the weights apply: densification's end; our
    choice."""


class NoiseWeighting(Component):
    """Multiplies the loss of an LR view by a weight that falls with the view's own residual.

    Model photograph v as the render plus Gaussian noise of unknown variance s_v. The negative log
    likelihood of its N_v values is

        N_v / 2 log(s_v) + sum of |render - photograph|^2 / (2 s_v).

    It is least for s_v = r_v, the mean squared residual, and then weighs the residuals of the view
    by 1 / r_v. So from step `begin` on, the loss of LR view v is multiplied by

        w_v = min(1, max(floor, r_HR / r_v)),

    where r_HR is the mean of r_v over the HR views. HR views have weight 1.

    Ours:

    - Residuals are compared at one sampling rate. An HR photograph has more detail than any LR
      photograph, and so larger residuals: at the photographs' own sizes r_HR / r_v is above 1. So
      the residual of each view is first downsampled (antialiased bicubic) to the lowest sampling
      rate of all views.
    - r_v is a running mean over about the last ten steps on the view, of the pixels inside its
      mask. It is measured from the first step on.
    - The likelihood has squared residuals. Most of the loss is their absolute value, for which the
      best weight would be the root of w_v.

    Every residual counts as noise, whatever its cause. But Gaussians imitate a lot, such as an
    unknown blur, or noise that only few views see, and then leave no residual. So this is a guard
    against single photographs that fit no others, and not a measure of noise.

    The hooks of plugins run after those of xrgs's own components, so that the weight multiplies the
    penalties of `regularization`, `exposure` and `formation` as well.

    Adam [kingma2015] divides a gradient by its recent size, so that a weight only has an effect on
    Gaussians that both LR and HR views see.

    `noise_weighting.residual_HR` and `residual_LR` record the root of r_v, in values of range 1,
    and `noise_weighting.LR` the weight of an LR view.
    """

    settings_type = Settings

    def __init__(
        self, settings: Settings, views: Sequence[TrainingView], backend: str = "torch"
    ) -> None:
        """Compute the sizes at which residuals are compared.

        Args:
            settings: `components.plugins.noise_weighting` of the config.
            views: All training views.
            backend: `torch` or `native`: the implementation of the resampling.

        Raises:
            XrgsError: No view is tagged HR.
        """
        self.hr_names = [view.name for view in views if view.tag == "HR"]
        if not self.hr_names:
            raise XrgsError(
                f"components.plugins.noise_weighting.floor={settings.floor}: there is no HR view to"
                " compare the residuals of LR views with; set it to 1, or train on the mixed views"
                " (train.views=mixed)"
            )
        self.settings = settings
        self.backend = backend
        lowest = min(view.sampling_rate for view in views)
        self.sizes = {
            view.name: (
                max(1, round(view.camera.height * lowest / view.sampling_rate)),
                max(1, round(view.camera.width * lowest / view.sampling_rate)),
            )
            for view in views
        }
        """Height and width of each view at the lowest sampling rate."""
        self.residuals: dict[str, float] = {}
        """View -> r_v, for views that had a step."""
        self.steps: dict[str, int] = {}
        """View -> its number of steps, for the same views."""

    @classmethod
    def from_settings(cls, settings: Settings, setup: TrainingSetup) -> Self | None:
        """Build the component; a `floor` of 1 leaves it off.

        Raises:
            XrgsError: A setting is out of its range, or there is no HR view.
        """
        key = "components.plugins.noise_weighting"
        if not 0 <= settings.floor <= 1:
            raise XrgsError(f"{key}.floor={settings.floor}: must be from 0 to 1")
        check_not_negative(f"{key}.begin", settings.begin)
        return None if settings.floor == 1 else cls(settings, setup.data.train, setup.backend)

    def modify_loss(self, loss: Tensor, image: Tensor, gaussians: Gaussians, step: Step) -> Tensor:
        """Measure the view's residual; return the loss, from `begin` on times the view's weight."""
        del gaussians
        view = step.view
        self._measure(image.detach() - view.image, view)
        step.log[f"noise_weighting.residual_{view.tag}"] = math.sqrt(self.residuals[view.name])
        if view.tag == "HR" or step.nominal < self.settings.begin:
            return loss
        weight = self.weight(view.name)
        step.log["noise_weighting.LR"] = weight
        return loss * weight

    def weight(self, name: str) -> float:
        """Return w_v of an LR view that had a step; 1 before the first step on an HR view."""
        measured = [self.residuals[hr] for hr in self.hr_names if hr in self.residuals]
        residual = self.residuals[name]
        if not measured or residual == 0:
            return 1.0
        ratio = math.fsum(measured) / len(measured) / residual
        return min(1.0, max(self.settings.floor, ratio))

    def findings(self) -> list[str]:
        """Return a sentence on the lowest and the highest weight, with the photographs' names."""
        weights = {n: self.weight(n) for n in self.residuals if n not in self.hr_names}
        if not weights:
            return []
        low, high = min(weights, key=lambda n: weights[n]), max(weights, key=lambda n: weights[n])
        return [
            f"noise_weighting: the weights of the LR photographs are {weights[low]:.3f} ({low}) to"
            f" {weights[high]:.3f} ({high})"
        ]

    def state_dict(self) -> dict[str, Any]:
        """Return the running means and the numbers of steps, by view."""
        return {"residuals": self.residuals, "steps": self.steps}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore what `state_dict` returned."""
        self.residuals = {name: float(value) for name, value in state["residuals"].items()}
        self.steps = {name: int(value) for name, value in state["steps"].items()}

    @torch.no_grad()
    def _measure(self, residual: Tensor, view: TrainingView) -> None:
        """Update the view's r_v by the residual [H, W, 3] of a step, 0 outside the mask."""
        brought_down = resize(residual, *self.sizes[view.name], backend=self.backend)
        used = 1.0 if view.mask is None else int(view.mask.sum()) / view.mask.numel()
        square = rounded_mean(brought_down * brought_down) / used
        count = self.steps.get(view.name, 0) + 1
        mean = self.residuals.get(view.name, 0.0)
        self.residuals[view.name] = mean + max(1 / count, _LEAST_RATE) * (square - mean)
        self.steps[view.name] = count
