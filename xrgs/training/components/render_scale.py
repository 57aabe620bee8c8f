"""Resolution-aware rendering (paper 5.7 and 6.3)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from xrgs.splat.gaussians import ActivatedGaussians
from xrgs.training.components.base import Component, Step, TrainingView

if TYPE_CHECKING:  # xrgs.config loads Hydra, which training does without
    from xrgs.config import RenderScaleConf


class RenderScale(Component):
    """Resolution-aware rendering (paper 5.7): an LR view sees every Gaussian `k` times as large.

    `k = (R_max / R)^gamma`. The paper has k(R) and "the camera resolution" and says no more. R here
    is the longer side of the view in px, which a camera that is turned by 90 degrees keeps, and
    R_max the largest of all training views. So LR views that were degraded at their full size have
    k = 1, and nothing happens to them.

    Scales are inflated before the render, for this render alone: what is kept, optimised and shown
    are the Gaussians themselves, and the gradient of the log-scales is that of the inflated ones.
    """

    def __init__(self, conf: RenderScaleConf, views: Sequence[TrainingView]) -> None:
        largest = max(_side(view) for view in views)
        self.factors = {
            view.name: (largest / _side(view)) ** conf.gamma for view in views if view.tag == "LR"
        }

    def activated(self, activated: ActivatedGaussians, step: Step) -> ActivatedGaussians:
        """Scales times k in an LR view."""
        factor = self.factors.get(step.view.name)
        if factor is None:
            return activated
        step.log["render_scale.k"] = factor
        return activated._replace(scales=activated.scales * factor)


def _side(view: TrainingView) -> int:
    return max(view.camera.width, view.camera.height)
