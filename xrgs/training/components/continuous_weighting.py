"""Continuous weighting, in place of the binary tag (paper, conclusion)."""

from __future__ import annotations

from typing import TYPE_CHECKING

from xrgs.training.components.base import TrainingView

if TYPE_CHECKING:  # xrgs.config loads Hydra, which training does without
    from xrgs.config import ContinuousWeightingConf


class ContinuousWeighting:
    """Every view weighs `rho ** gamma`, whatever its tag.

    `rho`, in 0..1, is how finely a view samples the scene, over the finest of all: of synthetic LR
    views about 1 / factor, of real captures what focal length and distance make it. A view that was
    degraded at its full size keeps the rate that its pixels pretend to.

    The paper names the idea and no formula. gamma 0.86, log 4 over log 5, gives an LR view of
    factor 5 the paper's weight of 0.25 (of pixel counts, rho squared, the power would be 0.43).
    """

    def __init__(self, conf: ContinuousWeightingConf) -> None:
        self.gamma = conf.gamma

    def __call__(self, view: TrainingView) -> float:
        """The view's weight."""
        return float(view.rho**self.gamma)
