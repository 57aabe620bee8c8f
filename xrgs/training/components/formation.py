"""The blur of LR photographs, as trained parameters."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from xrgs.training.components.adam import RowAdam

if TYPE_CHECKING:
    from xrgs.config import FormationConf
    from xrgs.training.components.base import Step, TrainingView

BOX = math.sqrt(1 / 12)
"""Standard deviation of a box of one pixel, px: the least blur, by the area of a sensor's pixel."""


class BlurWidths:
    """The standard deviations, along y and x, of the blur of LR photographs, which are trained.

    A photograph is blurred by the lens, by motion and by the area of its pixels, all of them
    unknown. The render S of a view, k times as large as the photograph, is downsampled by

        D(S) = R G(sigma) S,

    where R is the antialiased bicubic resampling of `supersampled`, and G(sigma) a Gaussian blur
    with a standard deviation for each axis, in px of the photograph (`xrgs.splat.resample.resize`).
    The second moment of R's kernel is 0, so sigma is nearly the whole blur of the photograph. For
    example, a Gaussian of 0.8 px and the box of a pixel, 0.85 px together, give a sigma of 0.83 px.
    R damps the highest frequencies like the box, so for the box without other blur sigma goes to 0.

    Each sigma starts at the box of a pixel, sqrt(1/12) px. Adam [kingma2015] trains its logarithm
    at the rate `lr`, with `prior` times the square of log(sigma / box) in the loss. The prior
    decides where the photographs do not. With `widths=tag` all LR views share a pair of widths;
    with `widths=view` each LR view has its own, updated only at its steps. HR views have none:
    otherwise Gaussians and widths could become sharper together.

    BAGS [peng2024] trains a network for a kernel at each pixel; one Gaussian for all views, its
    start and its prior are our choice.

    `formation.sigma_x` and `formation.sigma_y` record the widths of the step's view along x and y.
    """

    def __init__(self, settings: FormationConf, views: Sequence[TrainingView]) -> None:
        """Start with the box of a pixel for each of the LR training views."""
        self.settings = settings
        shared = settings.widths == "tag"
        self.rows = {view.name: 0 if shared else row for row, view in enumerate(views)}
        """View name -> row of its widths in `logs`."""
        count = len(set(self.rows.values()))
        self.logs = RowAdam(torch.full((count, 2), math.log(BOX), dtype=torch.float64))
        """Natural logarithms of the widths along y and x [R, 2]."""
        self.drawn: Tensor | None = None
        """Log widths of the step's view [2], on which the gradient accumulates."""

    def of(self, name: str) -> tuple[float, float]:
        """Return the widths of a view along y and x, px of its photograph."""
        down, across = self.logs.values[self.rows[name]].exp().float().tolist()
        return down, across

    def variances(self, step: Step, factor: int) -> Tensor:
        """Return the variances [2] of the blur of the step's view, px^2 of its render.

        Args:
            step: The step, on an LR view. If gradients are enabled, its log records the widths.
            factor: Size of the render over the size of the photograph.
        """
        logs = self.logs.values[self.rows[step.view.name]].clone()
        if torch.is_grad_enabled():  # not for other components' renders
            self.drawn = logs.requires_grad_()
            step.log["formation.sigma_y"], step.log["formation.sigma_x"] = self.of(step.view.name)
        return (factor * logs.exp()).square()

    def learn(self, step: Step) -> None:
        """Update the widths of the step's view, after the backward pass."""
        if self.drawn is None or self.drawn.grad is None:
            return
        logs = self.drawn.detach()
        # Rounded: the last digits of a sum in double depend on the processor.
        gradient = self.drawn.grad.float().double()
        gradient += 2 * self.settings.prior * (logs - math.log(BOX))
        self.logs.update(self.rows[step.view.name], gradient, self.settings.lr)
        self.drawn = None

    def findings(self) -> list[str]:
        """Return a line with the widths; with `widths=view`, with the smallest and the largest."""
        if not self.rows:
            return []
        blurs = {name: math.hypot(*self.of(name)) / math.sqrt(2) for name in self.rows}
        low, high = min(blurs, key=lambda n: blurs[n]), max(blurs, key=lambda n: blurs[n])
        if self.settings.widths == "tag":
            down, across = self.of(low)
            return [f"formation: LR views: {across:.2f} px of blur across, {down:.2f} down"]
        return [
            f"formation: LR views: {blurs[low]:.2f} px of blur ({low}) to {blurs[high]:.2f} px"
            f" ({high})"
        ]

    def state_dict(self) -> dict[str, Any]:
        """Return the logarithms of the widths and the state of their optimizer."""
        return self.logs.state_dict()

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore a state of `state_dict`."""
        self.logs.load_state_dict(state)
