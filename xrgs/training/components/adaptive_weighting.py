"""Adaptive weighting [xrgs, section 7.2, proposal 1]."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from xrgs.splat.rounding import rounded_mean
from xrgs.training.components.base import Step, TrainingView
from xrgs.training.components.texture import gradient_magnitude

if TYPE_CHECKING:  # xrgs.config loads Hydra, which training does without
    from xrgs.config import AdaptiveWeightingConf


class AdaptiveWeighting:
    """Attenuates LR views in proportion to the texture of the scene.

    The attenuation is `min(1, g / texture)`, where g is the mean of `gradient_magnitude` over all
    pixels of all LR views, in intensity per px. It is computed once. A flat scene, whose LR views
    lack no detail, is not attenuated at all; from `texture` on the attenuation is complete, and it
    is linear in between.

    Our choice where the paper is silent: section 7.2 proposes to "estimate image texture (e.g., via
    Fourier or gradient magnitude) and increase LR weighting when the scene is globally
    low-frequency", without measure or weights. Measure, ramp and threshold are ours. `texture` 0.07
    lies between the LLFF scenes that the paper calls cluttered (fern, flower, horns: 0.074 to 0.12
    at factor 5 of 504 and 1008 px) and the simple ones (fortress 0.055; a single object 0.03 to
    0.04).
    """

    def __init__(self, settings: AdaptiveWeightingConf, views: Sequence[TrainingView]) -> None:
        """Measure the texture of the scene.

        Args:
            settings: The component's settings; `texture` is above 0.
            views: All training views; those tagged LR are measured.
        """
        magnitudes = [rounded_mean(gradient_magnitude(v.image)) for v in views if v.tag == "LR"]
        self.mean_gradient = sum(magnitudes) / len(magnitudes) if magnitudes else 0.0
        self.attenuation = min(1.0, self.mean_gradient / settings.texture)

    def __call__(self, step: Step) -> float:
        """Return the attenuation, the same at every step."""
        del step
        return self.attenuation
