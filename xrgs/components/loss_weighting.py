"""Resolution-aware loss weighting (paper 5.2)."""

from __future__ import annotations

from typing import TYPE_CHECKING

from xrgs.components.base import Component, Step
from xrgs.errors import XrgsError

if TYPE_CHECKING:  # xrgs.config loads Hydra, which training does without
    from torch import Tensor

    from xrgs.config import LossWeightingConf


class LossWeighting(Component):
    """Resolution-aware loss weighting (paper 5.2): the whole loss of an LR view x `lr_weight`.

    It scales the view's image-plane gradients too, and so changes what is densified, unless
    `stat_from` is `unweighted`: densification then reads them as they would be without the weight.
    A weight of 0 leaves no gradient to read.

    Adam divides a gradient by the size that it had of late: what only LR views see is moved as fast
    as without a weight. It decides where LR and HR views see the same, and what is densified.
    """

    def __init__(self, conf: LossWeightingConf) -> None:
        if conf.stat_from not in {"weighted", "unweighted"}:
            raise XrgsError(
                f"components.loss_weighting.stat_from={conf.stat_from}: must be weighted or"
                " unweighted"
            )
        self.lr_weight = conf.lr_weight
        self.reads_unweighted = conf.stat_from == "unweighted" and conf.lr_weight != 0

    def loss(self, loss: Tensor, image: Tensor, step: Step) -> Tensor:
        """`loss * lr_weight` in an LR view."""
        del image
        if step.view.tag != "LR":
            return loss
        step.log["loss_weighting.lr_weight"] = self.lr_weight
        return loss * self.lr_weight

    def statistic(self, gradient: Tensor, step: Step) -> Tensor:
        """`gradient / lr_weight` in an LR view, where densification is not to see the weight."""
        if self.reads_unweighted and step.view.tag == "LR":
            return gradient / self.lr_weight
        return gradient
