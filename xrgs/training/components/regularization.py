"""Penalties on the opacities and the scales of all Gaussians."""

from __future__ import annotations

from typing import TYPE_CHECKING, Self

import torch
from torch import Tensor

from xrgs.training.components.base import Component, Step, TrainingSetup, check_not_negative

if TYPE_CHECKING:
    from xrgs.config import RegularizationConf
    from xrgs.splat.gaussians import Gaussians


class Regularization(Component):
    """Adds penalties to the loss, so that Gaussians fade and shrink where no photograph resists.

    3DGS-MCMC [kheradmand2024], as gsplat's trainer has them: to the loss of every step,

        opacity * (mean of all opacities)  +  scale * (mean of all scales on all axes)

    is added, opacities in 0..1 and scales in world units. `MCMCStrategy` lives on Gaussians that
    fade; the penalties work with other strategies too.

    Our choice: weights of the loss of LR views (`Weighting`) do not apply to the penalties.
    """

    def __init__(self, settings: RegularizationConf, backend: str) -> None:
        """Take the weights, and the backend that computes opacities and scales."""
        self.settings, self.backend = settings, backend

    @classmethod
    def from_settings(cls, settings: RegularizationConf, setup: TrainingSetup) -> Self | None:
        """Build the component; two weights of 0 leave it off.

        Raises:
            XrgsError: A weight is below 0.
        """
        for name in ("opacity", "scale"):
            check_not_negative(f"components.regularization.{name}", getattr(settings, name))
        return cls(settings, setup.backend) if settings.opacity or settings.scale else None

    def modify_loss(self, loss: Tensor, image: Tensor, gaussians: Gaussians, step: Step) -> Tensor:
        """Add the penalties; `regularization.opacity` and `.scale` record the means."""
        del image
        activated = gaussians.activated(backend=self.backend)
        for name, values in (("opacity", activated.opacities), ("scale", activated.scales)):
            if weight := getattr(self.settings, name):
                # In double, since the sums of float32 depend on how torch adds.
                mean = values.mean(dtype=torch.float64)
                step.log[f"regularization.{name}"] = mean.to(values.dtype).item()
                loss = loss + (weight * mean).to(loss)
        return loss
