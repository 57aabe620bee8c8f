"""Continuous weighting, in place of the binary tag [xrgs, conclusion]."""

from __future__ import annotations

from typing import TYPE_CHECKING

from xrgs.training.components.base import TrainingView

if TYPE_CHECKING:  # xrgs.config loads Hydra, which training does without
    from xrgs.config import ContinuousWeightingConf


class ContinuousWeighting:
    """Weights a view by its sampling rate, `rho ** gamma`, whatever its tag.

    `rho`, in (0, 1], is the sampling rate of the view (focal length in px over the median depth of
    the scene) divided by the highest rate of all views. For synthetic LR views it is about
    1 / factor; for real photographs it follows from focal length and distance. A view that was
    degraded without shrinking it has the rate of its size in pixels.

    Our choice where the paper is silent: the conclusion proposes "a continuous, texture-aware
    weighting scheme" and gives no formula. The power law is ours. gamma = 0.86, log 4 / log 5,
    gives an LR view at factor 5 the paper's weight of 0.25. (As a power of the number of pixels,
    which goes with rho squared, it would be 0.43.)
    """

    def __init__(self, settings: ContinuousWeightingConf) -> None:
        """Take the power from the settings."""
        self.gamma = settings.gamma

    def __call__(self, view: TrainingView) -> float:
        """Return the view's weight."""
        return float(view.rho**self.gamma)
