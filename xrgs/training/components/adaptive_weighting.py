"""Adaptive weighting (paper 7.2, 1)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from xrgs.training.components.base import Step, TrainingView
from xrgs.training.components.texture import gradient_magnitude

if TYPE_CHECKING:  # xrgs.config loads Hydra, which training does without
    from xrgs.config import AdaptiveWeightingConf


class AdaptiveWeighting:
    """LR views weigh the more, the less texture the scene has (paper 7.2, 1).

    The share of the attenuation that stays is `min(1, g / texture)`, where g is the mean over all
    LR views and their pixels of the gradient's magnitude: none in a flat scene, whose LR views lack
    nothing, all of it from `texture` on, linear in between. It is computed once.

    The paper says neither how texture is measured nor what weight it gives. `texture` 0.07 lies
    between the LLFF scenes that the paper calls cluttered (fern, flower, horns: 0.074 to 0.12 at
    factor 5 of 504 and 1008 px) and the simple ones (fortress 0.055; a single object 0.03 to 0.04).
    """

    def __init__(self, conf: AdaptiveWeightingConf, views: Sequence[TrainingView]) -> None:
        magnitudes = [gradient_magnitude(v.image).mean().item() for v in views if v.tag == "LR"]
        self.gradient = sum(magnitudes) / len(magnitudes) if magnitudes else 0.0
        self.share = min(1.0, self.gradient / conf.texture)

    def __call__(self, step: Step) -> float:
        """Of the attenuation, what stays: the same at every step."""
        del step
        return self.share
