"""The components of XR-GS, one file each, and the hooks by which training calls them.

A component that is switched off isn't built, so a baseline runs none of their code. To add one: its
fields in `xrgs.config` with their off values in `conf/config.yaml`, a file here with a `Component`
that overrides the hooks it needs, its lines in `build`; one that changes from step to step has
`state_dict` and `load_state_dict`, too. What the paper leaves open is fixed in the components'
docstrings.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from xrgs.errors import XrgsError
from xrgs.training.components.adaptive_weighting import AdaptiveWeighting
from xrgs.training.components.base import Component, Components, Step, TrainingView, not_negative
from xrgs.training.components.consistency import Consistency
from xrgs.training.components.continuous_weighting import ContinuousWeighting
from xrgs.training.components.curriculum import Curriculum
from xrgs.training.components.densify import Densify
from xrgs.training.components.gradient_scaling import GradientScaling
from xrgs.training.components.hybrid_schedule import HybridSchedule
from xrgs.training.components.loss_weighting import LossWeighting
from xrgs.training.components.mip import Mip
from xrgs.training.components.region_weighting import region_shares
from xrgs.training.components.render_scale import RenderScale
from xrgs.training.components.weighting import Base, Share, Weighting

if TYPE_CHECKING:  # xrgs.config loads Hydra, which training does without
    from xrgs.capture.dataset import Dataset
    from xrgs.config import ComponentsConf, SplatConf

__all__ = ["Component", "Components", "Step", "TrainingView", "build"]

#: Values that must be finite and 0 or more, as `components.<key>`.
_NOT_NEGATIVE = (
    "loss_weighting.lr_weight",
    "gradient_scaling.lr_scale",
    "densify.lr_grow",
    "densify.lr_prune",
    "curriculum.lr_only",
    "render_scale.gamma",
    "consistency.weight",
    "consistency.l1",
    "consistency.ssim",
    "adaptive_weighting.texture",
    "region_weighting.texture",
    "hybrid_schedule.ramp",
    "continuous_weighting.gamma",
    "mip.variance",
)


def build(
    conf: ComponentsConf, data: Dataset, splat: SplatConf, backend: str = "torch"
) -> Components:
    """The components that a config switches on.

    Args:
        conf: `components` of the config.
        data: What is trained on.
        splat: `splat` of the config.
        backend: `torch` or `native`, who computes losses.

    Raises:
        XrgsError: A value is out of its range, a view is too small for its paired target, or a
            component has no view or weight to work on.
    """
    for key in _NOT_NEGATIVE:
        group, name = key.split(".")
        not_negative(f"components.{key}", getattr(getattr(conf, group), name))
    if conf.mip.every < 1:
        raise XrgsError(f"components.mip.every={conf.mip.every}: must be at least 1")
    components: list[Component] = []
    if conf.consistency.weight != 0:
        components.append(Consistency(conf.consistency, data.train, data.factor, backend))
    # After consistency: a view's weight multiplies its consistency loss too, which would otherwise
    # give back to LR views what weighting took from them.
    components += _weighting(conf, data, splat)
    if conf.gradient_scaling.lr_scale != 1:
        components.append(GradientScaling(conf.gradient_scaling))
    if conf.densify.decide != "nobody":
        components.append(Densify(conf.densify))
    if conf.curriculum.lr_only != 0:
        components.append(Curriculum(conf.curriculum, data.train))
    if conf.mip.variance != 0:
        components.append(Mip(conf.mip, data.train, splat.raster.near))
    if conf.render_scale.gamma != 0:
        components.append(RenderScale(conf.render_scale, data.train))
    return Components(components)


def _weighting(conf: ComponentsConf, data: Dataset, splat: SplatConf) -> list[Weighting]:
    """All that weighs views, as the one component that it is; none where nothing does."""
    base: Base | None = None
    if conf.continuous_weighting.gamma != 0:  # in place of the tag, where both are set
        base = ContinuousWeighting(conf.continuous_weighting)
    elif conf.loss_weighting.lr_weight != 1:
        base = LossWeighting(conf.loss_weighting)
    relieved = {
        "adaptive_weighting.texture": conf.adaptive_weighting.texture,
        "region_weighting.texture": conf.region_weighting.texture,
        "hybrid_schedule.ramp": conf.hybrid_schedule.ramp,
    }
    if base is None:
        for key, value in relieved.items():
            if value != 0:
                raise XrgsError(
                    f"components.{key}={value}: gives back what a weight takes from LR views, and"
                    " neither loss_weighting.lr_weight nor continuous_weighting.gamma takes any"
                )
        return []
    shares: list[Share] = []
    if conf.adaptive_weighting.texture != 0:
        shares.append(AdaptiveWeighting(conf.adaptive_weighting, data.train))
    if conf.hybrid_schedule.ramp != 0:
        shares.append(HybridSchedule(conf.hybrid_schedule, splat.densify.stop))
    regions = None
    if conf.region_weighting.texture != 0:
        regions = region_shares(conf.region_weighting, data.train, data.points, splat.raster.near)
    return [Weighting(base, shares, regions, stat_from=conf.loss_weighting.stat_from)]
