"""Gradient scaling for Gaussian radii (paper 5.3)."""

from __future__ import annotations

from typing import TYPE_CHECKING

from xrgs.training.components.base import Component, Step

if TYPE_CHECKING:  # xrgs.config loads Hydra, which training does without
    from xrgs.config import GradientScalingConf
    from xrgs.splat.gaussians import Gaussians


class GradientScaling(Component):
    """Gradient scaling for Gaussian radii (paper 5.3): LR views move the scales less.

    Only the gradient of the log-scales is touched: not means, quaternions, opacities or colours,
    nor the image-plane gradient that densification reads.
    """

    def __init__(self, conf: GradientScalingConf) -> None:
        self.lr_scale = conf.lr_scale

    def after_backward(self, gaussians: Gaussians, step: Step) -> None:
        """`scales.grad * lr_scale` in an LR view."""
        gradient = gaussians.scales.grad
        if gradient is None:
            return
        # Before scaling: how much of what moves the scales comes from which views.
        step.log[f"gradient_scaling.norm_{step.view.tag}"] = gradient.norm().item()
        if step.view.tag == "LR":
            gradient.mul_(self.lr_scale)
