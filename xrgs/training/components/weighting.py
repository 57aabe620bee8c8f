"""The weight of a view in the loss, whichever settings decide it [xrgs, sections 5.2 and 7.2]."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from math import prod
from typing import TYPE_CHECKING, Self

from torch import Tensor

from xrgs.errors import XrgsError
from xrgs.splat.rounding import rounded_mean
from xrgs.training.components.adaptive_weighting import AdaptiveWeighting
from xrgs.training.components.base import (
    Component,
    Step,
    TrainingSetup,
    TrainingView,
    check_not_negative,
)
from xrgs.training.components.continuous_weighting import ContinuousWeighting
from xrgs.training.components.hybrid_schedule import HybridSchedule
from xrgs.training.components.loss_weighting import LossWeighting
from xrgs.training.components.region_weighting import region_attenuations

if TYPE_CHECKING:  # xrgs.config loads Hydra, which training does without
    from xrgs.config import ComponentsConf, LossWeightingConf
    from xrgs.splat.gaussians import Gaussians

ViewWeight = Callable[[TrainingView], float]
"""The weight of a view that its resolution alone gives, the lowest that it can have."""
Attenuation = Callable[[Step], float]
"""The part, in 0..1, of the reduction `1 - view_weight` that applies at a step."""

_STATISTICS = ("weighted", "unweighted")


class Weighting(Component):
    """Multiplies the loss of a view, and with it its gradients, by the weight of the view.

        weight = view_weight + (1 - view_weight) (1 - a_1 a_2 ...)

    `view_weight` is the weight by tag of loss weighting [xrgs, section 5.2], or the weight by
    sampling rate of continuous weighting in its place. Each attenuation a in 0..1 comes from
    adaptive weighting, the hybrid schedule or region weighting [xrgs, section 7.2]: 1 applies the
    whole reduction, 0 none of it.

    Our choice where the paper is silent: the paper proposes these separately. We multiply the
    attenuations, so that any of them can be combined, no view weighs less than its `view_weight`,
    and none weighs more than 1.

    Region weighting has an attenuation for every pixel. `weight` is then the mean over the view's
    pixels, and `pixel_weights` distributes it over them. The weight of each view whose
    `view_weight` is not 1 is recorded as `weighting.<tag>`.
    """

    def __init__(
        self,
        view_weight: ViewWeight,
        attenuations: Sequence[Attenuation] = (),
        regions: Mapping[str, Tensor] | None = None,
        *,
        stat_from: str = "weighted",
    ) -> None:
        """Combine a weight with its attenuations.

        Args:
            view_weight: The weight of each view, in 0..1.
            attenuations: The attenuations at each step, in 0..1.
            regions: The attenuations [H, W] in 0..1 of the pixels, by the names of the views that
                have them.
            stat_from: `weighted`, or `unweighted` where densification is to read image-plane
                gradients without the weights.

        Raises:
            XrgsError: `stat_from` is neither.
        """
        if stat_from not in _STATISTICS:
            raise XrgsError(
                f"components.loss_weighting.stat_from={stat_from}: must be weighted or unweighted"
            )
        self.view_weight = view_weight
        self.attenuations = attenuations
        self.regions = regions or {}
        self.region_means = {name: rounded_mean(region) for name, region in self.regions.items()}
        self.stat_from = stat_from

    @classmethod
    def from_settings(cls, settings: LossWeightingConf, setup: TrainingSetup) -> Self | None:
        """Build the component from `loss_weighting` and the settings that change its weight.

        Args:
            settings: `components.loss_weighting` of the config; an `lr_weight` of 1 is off.
            setup: Has the settings of continuous, adaptive and region weighting and of the hybrid
                schedule, each of which is off at 0.

        Returns:
            The component, or None where every view has weight 1.

        Raises:
            XrgsError: A setting is out of its range, or attenuates a weight that is off.
        """
        conf, data = setup.components, setup.data
        _check_ranges(conf)
        view_weight: ViewWeight
        if conf.continuous_weighting.gamma != 0:  # in place of the tag where both are set
            view_weight = ContinuousWeighting(conf.continuous_weighting)
        elif settings.lr_weight != 1:
            view_weight = LossWeighting(settings)
        else:
            _check_no_attenuation(conf)
            return None
        attenuations: list[Attenuation] = []
        if conf.adaptive_weighting.texture != 0:
            attenuations.append(AdaptiveWeighting(conf.adaptive_weighting, data.train))
        if conf.hybrid_schedule.ramp != 0:
            attenuations.append(HybridSchedule(conf.hybrid_schedule, setup.splat.densify.stop))
        regions = None
        if conf.region_weighting.texture != 0:
            near = setup.splat.raster.near
            regions = region_attenuations(conf.region_weighting, data.train, data.points, near)
        return cls(view_weight, attenuations, regions, stat_from=settings.stat_from)

    def weight(self, step: Step) -> float:
        """Return the weight of the step's view, the mean over its pixels."""
        region_mean = self.region_means.get(step.view.name, 1.0)
        view_weight = self.view_weight(step.view)
        return view_weight + (1 - view_weight) * (1 - self._attenuation(step) * region_mean)

    def pixel_weights(self, step: Step) -> Tensor | None:
        """Return the weights [H, W] of the pixels over their mean; None where all are equal."""
        region = self.regions.get(step.view.name)
        mean = self.weight(step)
        # A mean of 0 leaves nothing to distribute: every pixel has weight 0.
        if region is None or mean == 0:
            return None
        view_weight = self.view_weight(step.view)
        return (view_weight + (1 - view_weight) * (1 - self._attenuation(step) * region)) / mean

    def modify_loss(self, loss: Tensor, image: Tensor, gaussians: Gaussians, step: Step) -> Tensor:
        """Return `loss * weight`, or `loss` itself where the weight is 1."""
        del image, gaussians
        weight = self.weight(step)
        if self.view_weight(step.view) != 1:
            step.log[f"weighting.{step.view.tag}"] = weight
        return loss if weight == 1 else loss * weight

    def densification_grad2d(self, grad2d: Tensor, step: Step) -> Tensor:
        """Return the gradient divided by the view's weight where `stat_from` is `unweighted`."""
        weight = self.weight(step)
        if self.stat_from == "weighted" or weight in {0, 1}:
            return grad2d
        return grad2d / weight

    def _attenuation(self, step: Step) -> float:
        return prod(attenuation(step) for attenuation in self.attenuations)


def _attenuating_settings(conf: ComponentsConf) -> dict[str, float]:
    """The settings that attenuate a view's weight, by their keys; each is off at 0."""
    return {
        "components.adaptive_weighting.texture": conf.adaptive_weighting.texture,
        "components.region_weighting.texture": conf.region_weighting.texture,
        "components.hybrid_schedule.ramp": conf.hybrid_schedule.ramp,
    }


def _check_ranges(conf: ComponentsConf) -> None:
    check_not_negative("components.loss_weighting.lr_weight", conf.loss_weighting.lr_weight)
    gamma = conf.continuous_weighting.gamma
    check_not_negative("components.continuous_weighting.gamma", gamma)
    for key, value in _attenuating_settings(conf).items():
        check_not_negative(key, value)


def _check_no_attenuation(conf: ComponentsConf) -> None:
    """Refuse settings that would have no effect, because every view has weight 1."""
    for key, value in _attenuating_settings(conf).items():
        if value != 0:
            raise XrgsError(
                f"{key}={value}: this raises the weight of LR views, which is 1 already; set"
                " components.loss_weighting.lr_weight or components.continuous_weighting.gamma too"
            )
