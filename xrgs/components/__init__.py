"""The components of XR-GS, one file each, and the hooks by which training calls them.

A component that is switched off isn't built, so a baseline runs none of their code. To add one: its
fields in `xrgs.config` with their off values in `conf/config.yaml`, a file here with a `Component`
that overrides the hooks it needs, its lines in `build`. What the paper leaves open is fixed in the
components' docstrings.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from xrgs.components.base import Component, Components, Step, TrainingView, not_negative
from xrgs.components.consistency import Consistency
from xrgs.components.curriculum import Curriculum
from xrgs.components.gradient_scaling import GradientScaling
from xrgs.components.loss_weighting import LossWeighting
from xrgs.components.render_scale import RenderScale

if TYPE_CHECKING:  # xrgs.config loads Hydra, which training does without
    from xrgs.config import ComponentsConf

__all__ = ["Component", "Components", "Step", "TrainingView", "build"]


def build(
    conf: ComponentsConf, views: Sequence[TrainingView], factor: int, backend: str = "torch"
) -> Components:
    """The components that a config switches on.

    Args:
        conf: `components` of the config.
        views: Every training view.
        factor: `variant.factor`, how many times smaller an LR view is.
        backend: `torch` or `native`, who computes losses.

    Raises:
        XrgsError: A value is out of its range, a view is too small for its paired target, or there
            is no view that a component is for.
    """
    not_negative("components.loss_weighting.lr_weight", conf.loss_weighting.lr_weight)
    not_negative("components.gradient_scaling.lr_scale", conf.gradient_scaling.lr_scale)
    not_negative("components.curriculum.lr_only", conf.curriculum.lr_only)
    not_negative("components.render_scale.gamma", conf.render_scale.gamma)
    for name in ("weight", "l1", "ssim"):
        not_negative(f"components.consistency.{name}", getattr(conf.consistency, name))
    components: list[Component] = []
    if conf.consistency.weight != 0:
        components.append(Consistency(conf.consistency, views, factor, backend))
    # After consistency: a view's weight multiplies its consistency loss too, which would otherwise
    # give back to LR views what weighting took from them.
    if conf.loss_weighting.lr_weight != 1:
        components.append(LossWeighting(conf.loss_weighting))
    if conf.gradient_scaling.lr_scale != 1:
        components.append(GradientScaling(conf.gradient_scaling))
    if conf.curriculum.lr_only != 0:
        components.append(Curriculum(conf.curriculum, views))
    if conf.render_scale.gamma != 0:
        components.append(RenderScale(conf.render_scale, views))
    return Components(components)
