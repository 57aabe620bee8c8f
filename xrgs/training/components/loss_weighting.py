"""Resolution-aware loss weighting [xrgs, section 5.2]."""

from __future__ import annotations

from typing import TYPE_CHECKING

from xrgs.training.components.base import TrainingView

if TYPE_CHECKING:  # xrgs.config loads Hydra, which training does without
    from xrgs.config import LossWeightingConf


class LossWeighting:
    """Weights a view by its tag: 1 for HR views, `lr_weight` for LR views.

    Section 5.2 of the paper multiplies the loss of a view:

        L = 1.0 L_base for an HR view, 0.25 L_base for an LR view.

    `xrgs.training.components.weighting` multiplies the whole loss of the view by this weight. That
    scales the view's image-plane gradients too, and so changes what is densified.

    Our choice where the paper is silent: densification reads the gradients of the weighted loss
    (`stat_from: weighted`), as the formula has it. With `stat_from: unweighted` it reads them as
    they would be without the weight; a weight of 0 leaves no gradient to read.

    Adam [kingma2015] divides a gradient by its recent size, so that parameters which only LR views
    reach move as fast as without a weight. The weight decides where LR and HR views reach the same
    parameters, and what is densified.
    """

    def __init__(self, settings: LossWeightingConf) -> None:
        """Take the weight of LR views, dimensionless, from the settings."""
        self.lr_weight = settings.lr_weight

    def __call__(self, view: TrainingView) -> float:
        """Return the view's weight."""
        return self.lr_weight if view.tag == "LR" else 1.0
