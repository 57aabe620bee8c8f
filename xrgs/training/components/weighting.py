"""What a view weighs at a step, whatever weighs it (paper 5.2, 7.2, conclusion)."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from math import prod

from torch import Tensor

from xrgs.errors import XrgsError
from xrgs.training.components.base import Component, Step, TrainingView

Base = Callable[[TrainingView], float]
"""A view's weight as its resolution alone has it."""
Share = Callable[[Step], float]
"""Which share, 0 to 1, of what the base takes from a view stays taken at a step."""


class Weighting(Component):
    """A view's weight multiplies its whole loss, and with it all that its gradients move.

    `weight = base + (1 - base) * (1 - share)`. The base is loss weighting's (by tag) or continuous
    weighting's (by sampling rate). Each of adaptive, hybrid and region weighting has a share in
    0..1 of the base's attenuation that stays, 1 for all of it; shares multiply. So any of them may
    stand together, none takes a view below its base, and none lifts it above 1.

    Region weighting has a share for every pixel: `weight` is then the mean over the view, and
    `pixel_weight` how it is spread. The history has the weights of views whose base is
    not 1, by their tags.
    """

    def __init__(
        self,
        base: Base,
        shares: Sequence[Share] = (),
        regions: Mapping[str, Tensor] | None = None,
        *,
        stat_from: str = "weighted",
    ) -> None:
        """Fix what weighs.

        Args:
            base: Of each view.
            shares: Of adaptive weighting and the hybrid schedule, where they are on.
            regions: Of region weighting: [H, W] shares in 0..1, by the names of the views that
                have them.
            stat_from: `weighted`, or `unweighted`: densification is not to see the weights.

        Raises:
            XrgsError: `stat_from` is neither.
        """
        if stat_from not in {"weighted", "unweighted"}:
            raise XrgsError(
                f"components.loss_weighting.stat_from={stat_from}: must be weighted or unweighted"
            )
        self.base = base
        self.shares = shares
        self.regions = regions or {}
        self.means = {name: region.mean().item() for name, region in self.regions.items()}
        self.stat_from = stat_from

    def weight(self, step: Step) -> float:
        """Of the step's view, the mean over its pixels."""
        return self._relieved(step, self.means.get(step.view.name, 1.0))

    def pixel_weight(self, step: Step) -> Tensor | None:
        """The weight of each pixel [H, W] over their mean; None where all are the same."""
        region = self.regions.get(step.view.name)
        mean = self.weight(step)
        if region is None or mean == 0:
            return None
        base = self.base(step.view)
        return (base + (1 - base) * (1 - self._share(step) * region)) / mean

    def loss(self, loss: Tensor, image: Tensor, step: Step) -> Tensor:
        """`loss * weight`; the very loss where the weight is 1."""
        del image
        weight = self.weight(step)
        if self.base(step.view) != 1:
            step.log[f"weighting.{step.view.tag}"] = weight
        return loss if weight == 1 else loss * weight

    def densification_grad2d(self, gradient: Tensor, step: Step) -> Tensor:
        """The gradient over the view's weight, where densification is not to see it."""
        weight = self.weight(step)
        if self.stat_from == "weighted" or weight in {0, 1}:
            return gradient
        return gradient / weight

    def _share(self, step: Step) -> float:
        return prod(share(step) for share in self.shares)

    def _relieved(self, step: Step, region: float) -> float:
        base = self.base(step.view)
        return base + (1 - base) * (1 - self._share(step) * region)
