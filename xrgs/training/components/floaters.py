"""Removal of floaters: Gaussians in the empty space close to a camera."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Self

import torch
from torch import Tensor

from xrgs.training.components.base import Component, Step, TrainingSetup, TrainingView

if TYPE_CHECKING:
    from xrgs.config import FloatersConf
    from xrgs.splat.cameras import Camera
    from xrgs.splat.gaussians import Gaussians
    from xrgs.splat.settings import DensifySettings

_NEAREST = 0.01
"""Quantile of the SfM points' depths that is a view's near depth; the minimum may be an outlier."""


class Floaters(Component):
    """Removes Gaussians from the empty space between the cameras and the scene.

    A Gaussian close to a camera covers much of that camera's image and little of any other. Such a
    Gaussian can lower the loss of one view, and hides the scene from nearby test views. Let z_iv be
    the depth of Gaussian i in training view v, and q_v the 1st percentile of the depths of the SfM
    points that project into the image of v. Gaussian i is removed if its mean projects into the
    image of any training view v with

        0 < z_iv < near_share q_v.

    Gaussians are removed at step 0, at every multiple of `splat.densify.every`, also after
    densification, and at the last step. Hiding them in v would not help test views, which would
    still show them. The training views also protect a test view between them, since their empty
    spaces overlap.

    The component is our choice.

    Masks are not read: the space before the scene is empty at masked pixels too. A view without an
    SfM point in its image has no limit.
    """

    def __init__(
        self,
        settings: FloatersConf,
        views: Sequence[TrainingView],
        points: Tensor,
        densify: DensifySettings,
    ) -> None:
        """Measure the depths of the SfM points [P, 3], world units, in each training view."""
        self.settings, self.densify = settings, densify
        self.cameras = {view.name: view.camera for view in views}
        self.near = {name: _near(points, camera) for name, camera in self.cameras.items()}
        """View name -> q_v, the 1st percentile of the depths of its SfM points, world units."""
        self.removed = 0
        """Number of Gaussians that this component has removed."""

    @classmethod
    def from_settings(cls, settings: FloatersConf, setup: TrainingSetup) -> Self:
        """Build the component."""
        return cls(settings, setup.data.train, setup.data.points, setup.splat.densify)

    def to_prune(self, gaussians: Gaussians, step: Step) -> Tensor | None:
        """Return the Gaussians [N] that are too close to a training view; None if not due."""
        if step.number % self.densify.scaled(step.total).every and step.number < step.total - 1:
            return None
        means = gaussians.means.detach().T.contiguous().T  # each coordinate side by side in memory
        too_near = torch.zeros(len(gaussians), dtype=torch.bool, device=means.device)
        for name, camera in self.cameras.items():
            near = camera.depths(means) < self.settings.near_share * self.near[name]
            index = near.nonzero()[:, 0]  # few: only these are projected
            too_near[index] |= camera.in_image(means[index])[3]
        self.removed += int(too_near.sum())
        return too_near

    def findings(self) -> list[str]:
        """Return a line with the number of removed Gaussians."""
        return [f"floaters: {self.removed} Gaussians close to a camera were removed"]

    def state_dict(self) -> dict[str, Any]:
        """Return the number of removed Gaussians, the only state."""
        return {"removed": self.removed}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore a state of `state_dict`."""
        self.removed = int(state["removed"])


def _near(points: Tensor, camera: Camera) -> float:
    """Return the 1st percentile of the depths of the points [P, 3] in the image; 0 without any."""
    _, _, depth, inside = camera.in_image(points)
    if not inside.any():
        return 0.0
    # Not interpolated, since the last digits of an interpolation may depend on the processor.
    near: float = torch.quantile(depth[inside], _NEAREST, interpolation="lower").item()
    return near
