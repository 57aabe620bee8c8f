"""Resolution-aware loss weighting (paper 5.2)."""

from __future__ import annotations

from typing import TYPE_CHECKING

from xrgs.components.base import Component, Step

if TYPE_CHECKING:  # xrgs.config loads Hydra, which training does without
    from torch import Tensor

    from xrgs.config import LossWeightingConf


class LossWeighting(Component):
    """Resolution-aware loss weighting (paper 5.2): the whole loss of an LR view x `lr_weight`.

    It scales the view's image-plane gradients too, and so changes what is densified.
    """

    def __init__(self, conf: LossWeightingConf) -> None:
        self.lr_weight = conf.lr_weight

    def loss(self, loss: Tensor, image: Tensor, step: Step) -> Tensor:
        """`loss * lr_weight` in an LR view."""
        del image
        return loss * self.lr_weight if step.view.tag == "LR" else loss
