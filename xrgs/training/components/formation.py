"""How LR photographs were made, learned: the width of their blur."""

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
"""Standard deviation of a box as wide as a pixel, px: what a sensor's pixel blurs at the least."""


class BlurWidths:
    """The standard deviations of the blur of LR photographs, down and across, which are learned.

    A photograph is blurred by the lens, by motion, and by the area of its pixels, and a variant
    knows none of that. The render S of a view, at k times the size of its photograph, is brought
    down by

        D(S) = R G(sigma) S,

    where R is the antialiased bicubic resampling of `supersampled`, and G(sigma) a Gaussian with a
    standard deviation for each axis, in px of the photograph (`xrgs.splat.resample.resize`). The
    kernel of R has no second moment, so sigma is nearly all the blur of the photograph: 0.83 px
    where a Gaussian of 0.8 px comes before the box of a pixel, of 0.85 px together. R damps the
    highest frequencies like the box alone, for which sigma goes to 0.

    Each sigma begins at a pixel's box, sqrt(1/12) px, and its logarithm is learned by Adam
    [kingma2015] at the rate `lr`, with `prior` times the square of log(sigma / box) in the loss.
    The prior holds widths that photographs say nothing about. With `widths=tag` the LR views share
    a pair of widths, with `widths=view` each LR view has its own, which moves at steps on that view
    alone. HR views have none, or splats and widths could become sharper together.

    BAGS [peng2024] learns a kernel for each pixel by a network; one Gaussian for all views, its
    start and its prior are our choice.

    `formation.sigma_x` and `formation.sigma_y` record the widths of the step's view, across and
    down.
    """

    def __init__(self, settings: FormationConf, views: Sequence[TrainingView]) -> None:
        """Start with a pixel's box.

        Args:
            settings: `components.formation` of the config.
            views: The LR training views.
        """
        self.settings = settings
        shared = settings.widths == "tag"
        self.rows = {view.name: 0 if shared else row for row, view in enumerate(views)}
        """The row of each view's widths."""
        count = len(set(self.rows.values()))
        self.logs = RowAdam(torch.full((count, 2), math.log(BOX), dtype=torch.float64))
        """The logarithms of the widths, down and across [R, 2]."""
        self.drawn: Tensor | None = None
        """The logarithms of the step's view [2], which get the gradient."""

    def of(self, name: str) -> tuple[float, float]:
        """Return the widths of a view, down and across, px of its photograph."""
        down, across = self.logs.values[self.rows[name]].exp().float().tolist()
        return down, across

    def variances(self, step: Step, factor: int) -> Tensor:
        """Return the variances [2] of the blur of the step's view, px^2 of its render.

        Args:
            step: The step, on an LR view. Its log gets the widths where gradients are enabled.
            factor: How many times larger than the photograph the render is.
        """
        logs = self.logs.values[self.rows[step.view.name]].clone()
        if torch.is_grad_enabled():  # other renders are looked at, and teach nothing
            self.drawn = logs.requires_grad_()
            step.log["formation.sigma_y"], step.log["formation.sigma_x"] = self.of(step.view.name)
        return (factor * logs.exp()).square()

    def learn(self, step: Step) -> None:
        """Move the widths of the step's view, after the backward pass."""
        if self.drawn is None or self.drawn.grad is None:
            return
        logs = self.drawn.detach()
        # Rounded: the last digits of a sum in double depend on the processor.
        gradient = self.drawn.grad.float().double()
        gradient += 2 * self.settings.prior * (logs - math.log(BOX))
        self.logs.update(self.rows[step.view.name], gradient, self.settings.lr)
        self.drawn = None

    def findings(self) -> list[str]:
        """Return the widths, or the smallest and the largest where each view has its own."""
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
        """Restore what `state_dict` returned."""
        self.logs.load_state_dict(state)
