"""Resolution-aware rendering [xrgs, sections 5.7 and 6.3]."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Self

from xrgs.splat.gaussians import ActivatedGaussians
from xrgs.training.components.base import (
    Component,
    Step,
    TrainingSetup,
    TrainingView,
    check_not_negative,
)

if TYPE_CHECKING:
    from xrgs.config import RenderScaleConf


class RenderScale(Component):
    """Renders LR views with larger Gaussians.

    Section 5.7 of the paper scales the Gaussians by the camera resolution R at render time:

        sigma' = k(R) sigma

    Our choice where the paper is silent: `k = (R_max / R)^gamma`, where R is the longer side of the
    view in px, so that turning a camera by 90 degrees changes nothing, and R_max is R of the
    largest training view. LR views that were degraded at full size have k = 1. Only LR views are
    scaled, as in section 6.3. The paper gives no values; gamma 0.25 makes k 1.5 at factor 5.

    The scales in world units are multiplied for the render alone: the log-scales get the gradients
    of the scaled Gaussians. The Gaussians that are optimised, evaluated and saved stay as they are.
    The paper found that it blurs; it is off in the full system.
    """

    def __init__(self, settings: RenderScaleConf, views: Sequence[TrainingView]) -> None:
        """Compute k of each LR view among all training views."""
        largest = max(_long_side(view) for view in views)
        self.factors = {
            view.name: (largest / _long_side(view)) ** settings.gamma
            for view in views
            if view.tag == "LR"
        }

    @classmethod
    def from_settings(cls, settings: RenderScaleConf, setup: TrainingSetup) -> Self | None:
        """Build the component; a `gamma` of 0 leaves it off."""
        check_not_negative("components.render_scale.gamma", settings.gamma)
        return None if settings.gamma == 0 else cls(settings, setup.data.train)

    def before_render(self, activated: ActivatedGaussians, step: Step) -> ActivatedGaussians:
        """Multiply the scales by k in an LR view, and record k as `render_scale.k`."""
        factor = self.factors.get(step.view.name)
        if factor is None:
            return activated
        step.log["render_scale.k"] = factor
        return activated._replace(scales=activated.scales * factor)


def _long_side(view: TrainingView) -> int:
    """The longer side of a view, px."""
    return max(view.camera.width, view.camera.height)
