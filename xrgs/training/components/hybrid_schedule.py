"""Hybrid training schedule [xrgs, section 7.2, proposal 3]."""

from __future__ import annotations

from typing import TYPE_CHECKING

from xrgs.training.components.base import Step

if TYPE_CHECKING:  # xrgs.config loads Hydra, which training does without
    from xrgs.config import HybridScheduleConf


class HybridSchedule:
    """Attenuates LR views fully until densification stops, then less and less.

    The attenuation is 1 until step `splat.densify.stop` and falls linearly to 0 over the `ramp`
    steps that follow, both in steps of a 30,000-step run.

    Our choice where the paper is silent: section 7.2 proposes to "reintroduce LR influence in late
    training stages" and names no step. We start where densification ends: from there on LR views
    can refine the Gaussians that HR views have shaped, and cannot create new ones.
    """

    def __init__(self, settings: HybridScheduleConf, densify_stop: int) -> None:
        """Set the ramp.

        Args:
            settings: The component's settings; `ramp` is above 0.
            densify_stop: Step of a 30,000-step run at which densification stops.
        """
        self.start = densify_stop
        self.ramp = settings.ramp

    def __call__(self, step: Step) -> float:
        """Return the attenuation at a step, in 0..1."""
        return 1 - min(1.0, max(0.0, (step.nominal - self.start) / self.ramp))
