"""Resolution-aware rendering [xrgs, sections 5.7 and 6.3]."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Self

from xrgs.splat.gaussians import ActivatedGaussians
from xrgs.training.components.base import Component, Step, TrainingSetup, TrainingView

if TYPE_CHECKING:
    from xrgs.config import RenderScaleConf


class RenderScale(Component):
    """Renders LR views with larger Gaussians.

    Section 5.7 of the paper scales the Gaussians by the camera resolution R when rendering:

        sigma' = k(R) sigma

    Our choice where the paper is silent: `k = (R_max / R)^gamma`, where R is the longer side of the
    view in px (the same for portrait and landscape), and R_max is R of the largest training view.
    LR views degraded at full size have k = 1. Only LR views are scaled, as in section 6.3. The
    paper gives no values; gamma 0.25 makes k 1.5 at factor 5.

    The scales in world units are multiplied only for the render, and gradients reach the log scales
    through the factor. Optimised, evaluated and saved Gaussians are not scaled. The paper found
    that it blurs, and leaves it out of the full system.
    """

    def __init__(self, settings: RenderScaleConf, views: Sequence[TrainingView]) -> None:
        """Compute k of each LR view among all training views."""
        sides = {view.name: max(view.camera.width, view.camera.height) for view in views}
        largest = max(sides.values())
        self.factors = {
            view.name: (largest / sides[view.name]) ** settings.gamma
            for view in views
            if view.tag == "LR"
        }

    @classmethod
    def from_settings(cls, settings: RenderScaleConf, setup: TrainingSetup) -> Self:
        """Build the component."""
        return cls(settings, setup.data.train)

    def before_render(self, activated: ActivatedGaussians, step: Step) -> ActivatedGaussians:
        """Multiply the scales by k in an LR view, and record k as `render_scale.k`."""
        factor = self.factors.get(step.view.name)
        if factor is None:
            return activated
        step.log["render_scale.k"] = factor
        return activated._replace(scales=activated.scales * factor)
