"""Smaller gradients of Gaussians in the empty space close to a camera [philip2023]."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Self

import torch
from torch import Tensor

from xrgs.splat.gaussians import PARAMETERS
from xrgs.training.components import (
    Component,
    Step,
    TrainingSetup,
    TrainingView,
    check_not_negative,
)

if TYPE_CHECKING:
    from xrgs.splat.cameras import Camera
    from xrgs.splat.gaussians import Gaussians


@dataclass
class Settings:
    """The keys under `components.plugins.near_gradients` of the config."""

    share: float = 0.0
    """In a training view, gradients are reduced for Gaussians nearer than this share of the median
    depth of the view's SfM points; 0 is off. Our choice: 0.5."""


class NearGradients(Component):
    """Reduces a view's gradients for Gaussians close to its camera, where floaters are.

    Let z_iv be the depth of Gaussian i in training view v, and m_v the median depth of the SfM
    points that project into the image of v. At a step on view v, the gradients of all parameters of
    Gaussian i, and the image-plane gradient that densification reads, are multiplied by

        min(1, (z_iv / (share m_v))^2).

    Gradient scaling for radiance fields [philip2023] multiplies the gradients of each sample on a
    ray by min(1, d^2), where d is the distance from the camera in units of the scene. The density
    of a camera's rays falls with d^2, so that the space close to a camera gets the most gradients.

    Our choice: the depth instead of the distance, and the unit `share` m_v, which each view has for
    itself. Adam's steps do not depend on the size of gradients, so that this hardly slows a
    Gaussian that only one view sees. If several views see a Gaussian, the farther views move it
    most. Densification, whose threshold is absolute, grows fewer Gaussians close to cameras.

    Masks are not read: the space in front of the scene is empty at hidden pixels, too. A view
    without an SfM point in its image reduces no gradient.
    """

    settings_type = Settings

    def __init__(self, settings: Settings, views: Sequence[TrainingView], points: Tensor) -> None:
        """Measure the median depth of the SfM points [P, 3], world units, in each view."""
        self.share = settings.share
        self.median = {view.name: _median_depth(points, view.camera) for view in views}
        """View -> the median depth of its SfM points, world units; 0 without points."""
        self.factors: Tensor | None = None
        """The factors [N] on the step's gradients; None before the first step."""

    @classmethod
    def from_settings(cls, settings: Settings, setup: TrainingSetup) -> Self | None:
        """Build the component; a `share` of 0 leaves it off.

        Raises:
            XrgsError: The share is below 0 or not finite.
        """
        check_not_negative("components.plugins.near_gradients.share", settings.share)
        return cls(settings, setup.data.train, setup.data.points) if settings.share else None

    def after_backward(self, gaussians: Gaussians, step: Step) -> None:
        """Reduce the gradients of Gaussians close to the step's camera.

        `near_gradients.near` records the number of Gaussians with reduced gradients.
        """
        unit = self.share * self.median[step.view.name]
        depth = step.view.camera.to_camera(gaussians.means.detach())[2]  # [N]
        near = (depth > 0) & (depth < unit)
        self.factors = torch.where(near, (depth / unit).square(), 1.0)
        for name in PARAMETERS:
            gradient = gaussians[name].grad
            if gradient is not None:
                gradient.mul_(self.factors.reshape(-1, *[1] * (gradient.ndim - 1)))
                if name == "opacities":
                    step.log["near_gradients.near"] = int((near & (gradient != 0)).sum())

    def densification_grad2d(self, grad2d: Tensor, step: Step) -> Tensor:
        """Reduce the image-plane gradients [N, 2] by the same factors."""
        del step
        return grad2d if self.factors is None else grad2d * self.factors[:, None]


def _median_depth(points: Tensor, camera: Camera) -> float:
    """Return the median depth of the points [P, 3] in a view's image; 0 without points."""
    _, _, depth, inside = camera.in_image(points)
    if not inside.any():
        return 0.0
    # One of the depths, since the last digits of an interpolation may depend on the processor.
    median: float = torch.quantile(depth[inside], 0.5, interpolation="lower").item()
    return median
