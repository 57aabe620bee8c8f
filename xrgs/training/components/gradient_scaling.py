"""Gradient scaling of the Gaussians' scales in LR views [xrgs, section 5.3]."""

from __future__ import annotations

from typing import TYPE_CHECKING, Self

from xrgs.splat.rounding import rounded_norm
from xrgs.training.components.base import Component, Step, TrainingSetup

if TYPE_CHECKING:
    from xrgs.config import GradientScalingConf
    from xrgs.splat.gaussians import Gaussians


class GradientScaling(Component):
    """Multiplies the gradients of the Gaussians' log scales in LR views by a factor.

    Section 5.3 of the paper, with alpha = 0.3 found by grid search:

        grad_LR sigma <- alpha grad_LR sigma

    Our choice where the paper is silent: sigma is the trained parameter, the natural log of the
    scales, and the factor is applied between the backward pass and the optimizer. The gradients of
    means, quaternions, opacities and colours and the image-plane gradient for densification are not
    changed.
    """

    def __init__(self, settings: GradientScalingConf) -> None:
        self.lr_scale = settings.lr_scale

    @classmethod
    def from_settings(cls, settings: GradientScalingConf, setup: TrainingSetup) -> Self:
        """Build the component."""
        return cls(settings)

    def after_backward(self, gaussians: Gaussians, step: Step) -> None:
        """Multiply the gradient of the log scales by `lr_scale` in an LR view.

        `gradient_scaling.norm_<tag>` records the norm of the gradient before the factor: it shows
        which views change the scales most.
        """
        gradient = gaussians.scales.grad
        if gradient is None:
            return
        step.log[f"gradient_scaling.norm_{step.view.tag}"] = rounded_norm(gradient)
        if step.view.tag == "LR":
            gradient.mul_(self.lr_scale)
