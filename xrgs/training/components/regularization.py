"""Penalties on the opacities and the scales of all Gaussians."""

from __future__ import annotations

from typing import TYPE_CHECKING, Self

import torch
from torch import Tensor

from xrgs.training.components.base import Component, Step, TrainingSetup

if TYPE_CHECKING:
    from xrgs.config import RegularizationConf
    from xrgs.splat.gaussians import Gaussians


class Regularization(Component):
    """Penalises opacities and scales, so that Gaussians without effect on the loss fade and shrink.

    The penalties of 3DGS-MCMC [kheradmand2024], as in gsplat's trainer. At every step

        opacity * (mean of all opacities)  +  scale * (mean of all scales on all axes)

    is added to the loss, for opacities in 0..1 and scales in world units. `MCMCStrategy` relocates
    faded Gaussians, so it needs the penalties; they work with other strategies too.

    Our choice: the loss weights of LR views (`Weighting`) do not multiply the penalties.
    """

    def __init__(self, settings: RegularizationConf, backend: str) -> None:
        self.settings, self.backend = settings, backend

    @classmethod
    def from_settings(cls, settings: RegularizationConf, setup: TrainingSetup) -> Self:
        """Build the component."""
        return cls(settings, setup.backend)

    def modify_loss(self, loss: Tensor, image: Tensor, gaussians: Gaussians, step: Step) -> Tensor:
        """Add the penalties; `regularization.opacity` and `.scale` record the means."""
        activated = gaussians.activated(backend=self.backend)
        for name, values in (("opacity", activated.opacities), ("scale", activated.scales)):
            if weight := getattr(self.settings, name):
                # In double, since float32 sums depend on the order in which torch adds.
                mean = values.mean(dtype=torch.float64)
                step.log[f"regularization.{name}"] = mean.to(values.dtype).item()
                loss = loss + (weight * mean).to(loss)
        return loss
