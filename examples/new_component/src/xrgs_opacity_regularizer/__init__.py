"""An opacity regulariser for xrgs, as an example of a component in a package of its own."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Self

import torch

from xrgs.training.components import Component, Step, TrainingSetup, check_not_negative

if TYPE_CHECKING:
    from torch import Tensor

    from xrgs.splat.gaussians import Gaussians


@dataclass
class Settings:
    """The keys under `components.plugins.opacity_regularizer` of the config."""

    weight: float = 0.0
    """The weight of the mean opacity in the loss, dimensionless; 0 is off."""


class OpacityRegularizer(Component):
    """Adds the mean opacity to the loss, so that Gaussians of little use fade and are pruned.

    3DGS-MCMC [kheradmand2024] adds to the photometric loss

        weight * mean_i |o_i|,   o_i = sigmoid(opacity logit of Gaussian i),

    with a weight of 0.01 (the `opacity_reg` of gsplat's simple_trainer). The term has no view, so
    that the weight of the view does not multiply it.
    """

    settings_type = Settings

    def __init__(self, settings: Settings) -> None:
        """Take the weight from the settings."""
        self.weight = settings.weight

    @classmethod
    def from_settings(cls, settings: Settings, setup: TrainingSetup) -> Self | None:
        """Build the component; a `weight` of 0 leaves it off."""
        del setup
        check_not_negative("components.plugins.opacity_regularizer.weight", settings.weight)
        return None if settings.weight == 0 else cls(settings)

    def modify_loss(self, loss: Tensor, image: Tensor, gaussians: Gaussians, step: Step) -> Tensor:
        """Return the loss plus the term, and record the term for history.csv."""
        del image
        term = self.weight * torch.sigmoid(gaussians.opacities).mean()
        step.log["opacity_regularizer.term"] = term.item()
        return loss + term
