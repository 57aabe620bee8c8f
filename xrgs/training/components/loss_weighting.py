"""Resolution-aware loss weighting (paper 5.2)."""

from __future__ import annotations

from typing import TYPE_CHECKING

from xrgs.training.components.base import TrainingView

if TYPE_CHECKING:  # xrgs.config loads Hydra, which training does without
    from xrgs.config import LossWeightingConf


class LossWeighting:
    """Resolution-aware loss weighting (paper 5.2): the whole loss of an LR view x `lr_weight`.

    It is the base of `xrgs.training.components.weighting`, which does it. It scales the view's
    image-plane gradients too, and so changes what is densified, unless `stat_from` is `unweighted`:
    densification then reads them as they would be without the weight. A weight of 0 leaves no
    gradient to read.

    Adam divides a gradient by the size that it had of late: what only LR views see is moved as fast
    as without a weight. It decides where LR and HR views see the same, and what is densified.
    """

    def __init__(self, conf: LossWeightingConf) -> None:
        self.lr_weight = conf.lr_weight

    def __call__(self, view: TrainingView) -> float:
        """The view's weight."""
        return self.lr_weight if view.tag == "LR" else 1.0
