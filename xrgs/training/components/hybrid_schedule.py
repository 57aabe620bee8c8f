"""Hybrid training schedule (paper 7.2, 3)."""

from __future__ import annotations

from typing import TYPE_CHECKING

from xrgs.training.components.base import Step

if TYPE_CHECKING:  # xrgs.config loads Hydra, which training does without
    from xrgs.config import HybridScheduleConf


class HybridSchedule:
    """LR views come back to their full weight once densification is over (paper 7.2, 3).

    The share of the attenuation that stays is 1 until `densify.stop` and falls linearly to 0 over
    the `ramp` steps that follow. The paper says "late training stages" and no more: from there on
    LR views can refine what HR views have built, and can't make Gaussians.
    """

    def __init__(self, conf: HybridScheduleConf, densify_stop: int) -> None:
        self.start = densify_stop
        self.ramp = conf.ramp

    def __call__(self, step: Step) -> float:
        """Of the attenuation, what stays."""
        return 1 - min(1.0, max(0.0, (step.nominal - self.start) / self.ramp))
