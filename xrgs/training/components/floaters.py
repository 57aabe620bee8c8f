"""Guards against floaters: Gaussians in the empty space close to a camera."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Self

import torch
from torch import Tensor

from xrgs.splat.gaussians import PARAMETERS
from xrgs.training.components.base import (
    Component,
    Step,
    TrainingSetup,
    TrainingView,
    check_not_negative,
)

if TYPE_CHECKING:
    from xrgs.config import FloatersConf
    from xrgs.splat.cameras import Camera
    from xrgs.splat.gaussians import Gaussians
    from xrgs.splat.settings import DensifySettings

_NEAREST = 0.01
"""The share of a view's SfM points that are nearer than its near depth. A minimum would be the
depth of an outlier of SfM."""


class Floaters(Component):
    """Keeps Gaussians out of the empty space between the cameras and the scene.

    A Gaussian close to a camera covers much of the camera's image and little of any other image.
    Training may put one there to lower the loss of that view alone, and it hides the scene from
    test views near by. Let z_iv be the depth of Gaussian i in training view v. The depths of the
    SfM points that project into the image of v have the 1st percentile q_v and the median m_v.
    There are two guards. Each is off where its setting is 0.

    `near_share`, a: Gaussian i is removed if its mean projects into the image of any training view
    v with

        0 < z_iv < a q_v.

    Gaussians are removed at step 0, at every multiple of `splat.densify.every`, after densification
    too, and at the last step. They are removed from the model rather than left out of the renders
    of v, because test views have no limit of their own: they would still show them. The training
    views guard a test view among them, since their near spaces overlap.

    `gradient_share`, b: at a step on view v, the gradients of all parameters of Gaussian i, and the
    image-plane gradient that densification reads, are multiplied by

        min(1, (z_iv / (b m_v))^2).

    Gradient scaling for radiance fields [philip2023] multiplies the gradients of each sample on a
    ray by min(1, d^2), where d is the distance from the camera in units of the scene. The density
    of a camera's rays falls with d^2, so that the space close to a camera gets the most gradients.

    Our choice: the whole of the first guard; in the second, the depth in place of the distance, and
    the unit b m_v, which follows from each view. Adam's steps do not depend on the size of
    gradients, so that the second guard hardly slows a Gaussian that one view alone sees. Where
    several views see a Gaussian, the farther views move it most. Densification, whose threshold is
    absolute, grows fewer Gaussians close to cameras.

    Masks are not read: the space before the scene is empty at hidden pixels too. A view without an
    SfM point in its image has no limit and lessens no gradient.
    """

    def __init__(
        self,
        settings: FloatersConf,
        views: Sequence[TrainingView],
        points: Tensor,
        densify: DensifySettings,
    ) -> None:
        """Measure the depths of the SfM points in each view.

        Args:
            settings: `components.floaters` of the config.
            views: All training views.
            points: SfM points [P, 3], world units.
            densify: The schedule of densification, in steps of a 30,000-step run.
        """
        self.settings, self.densify = settings, densify
        self.cameras = {view.name: view.camera for view in views}
        found = {name: _near_and_median(points, camera) for name, camera in self.cameras.items()}
        self.near = {name: near for name, (near, _) in found.items()}
        """The 1st percentile of the depths of each view's SfM points, world units."""
        self.median = {name: median for name, (_, median) in found.items()}
        """Their median, world units."""
        self.factors: Tensor | None = None
        """The factors [N] of the step's gradients; None without `gradient_share`."""
        self.removed = 0
        """The number of Gaussians that have been removed for their depth."""

    @classmethod
    def from_settings(cls, settings: FloatersConf, setup: TrainingSetup) -> Self | None:
        """Build the component; it is off where both shares are 0.

        Raises:
            XrgsError: A share is below 0 or not finite.
        """
        for name in ("near_share", "gradient_share"):
            check_not_negative(f"components.floaters.{name}", getattr(settings, name))
        if settings.near_share == settings.gradient_share == 0:
            return None
        return cls(settings, setup.data.train, setup.data.points, setup.splat.densify)

    def after_backward(self, gaussians: Gaussians, step: Step) -> None:
        """Multiply the gradients of Gaussians close to the step's camera.

        `floaters.near` records the number of Gaussians with smaller gradients than before.
        """
        if self.settings.gradient_share == 0:
            return
        unit = self.settings.gradient_share * self.median[step.view.name]
        depth = step.view.camera.to_camera(gaussians.means.detach())[2]  # [N]
        near = (depth > 0) & (depth < unit)
        self.factors = torch.where(near, (depth / unit).square(), 1.0)
        for name in PARAMETERS:
            gradient = gaussians[name].grad
            if gradient is not None:
                gradient.mul_(self.factors.reshape(-1, *[1] * (gradient.ndim - 1)))
                if name == "opacities":
                    step.log["floaters.near"] = int((near & (gradient != 0)).sum())

    def densification_grad2d(self, grad2d: Tensor, step: Step) -> Tensor:
        """Multiply the image-plane gradients [N, 2] likewise."""
        del step
        return grad2d if self.factors is None else grad2d * self.factors[:, None]

    def to_prune(self, gaussians: Gaussians, step: Step) -> Tensor | None:
        """Return which Gaussians [N] are nearer to a training view than its limit, where due."""
        every = self.densify.scaled(step.total).every
        due = step.number % every == 0 or step.number == step.total - 1
        if self.settings.near_share == 0 or not due:
            return None
        means = gaussians.means.detach()
        too_near = torch.zeros(len(gaussians), dtype=torch.bool, device=means.device)
        for name, camera in self.cameras.items():
            _, _, depth, inside = camera.in_image(means)
            too_near |= inside & (depth < self.settings.near_share * self.near[name])
        self.removed += int(too_near.sum())
        return too_near

    def findings(self) -> list[str]:
        """Return how many Gaussians have been removed."""
        if not self.settings.near_share:
            return []
        return [f"floaters: {self.removed} Gaussians close to a camera were removed"]

    def state_dict(self) -> dict[str, Any]:
        """Return the number of removed Gaussians; all else follows from the views and the step."""
        return {"removed": self.removed}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore what `state_dict` returned."""
        self.removed = int(state["removed"])


def _near_and_median(points: Tensor, camera: Camera) -> tuple[float, float]:
    """The 1st percentile and the median depth of the points [P, 3] in a view's image; 0 of none."""
    _, _, depth, inside = camera.in_image(points)
    if not inside.any():
        return 0.0, 0.0
    shares = depth.new_tensor([_NEAREST, 0.5])
    # One of the depths, since the last digits of an interpolation may depend on the processor.
    near, median = torch.quantile(depth[inside], shares, interpolation="lower").tolist()
    return near, median
