"""The components of XR-GS, one named piece each, and the hooks by which training calls them.

A component that is switched off isn't built, so a baseline runs no line of this file. To add one:
its fields in `xrgs.config`, a `Component` here that overrides the hooks it needs, a line in
`build`. What the paper leaves open is fixed in the docstrings below.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Protocol

from torch import Tensor

from xrgs.errors import XrgsError
from xrgs.splat.loss import WINDOW, Target, photometric_loss, prepare_target
from xrgs.splat.resample import resize

if TYPE_CHECKING:  # xrgs.config loads Hydra, which training does without
    from xrgs.config import ComponentsConf, ConsistencyConf, GradientScalingConf, LossWeightingConf
    from xrgs.splat.gaussians import Gaussians


class TrainingView(Protocol):
    """What a component may know of a view."""

    @property
    def name(self) -> str:
        """Its photograph's, unique among the views."""

    @property
    def tag(self) -> str:
        """`HR` or `LR`."""

    @property
    def image(self) -> Tensor:
        """The photograph [H, W, 3] at the size it is rendered at."""


class Component:
    """One change to training. Each hook is the identity until a component overrides it."""

    def loss(self, loss: Tensor, image: Tensor, view: TrainingView) -> Tensor:
        """The loss to go on with, before backward.

        Args:
            loss: Scalar, what the components before this one made of the photometric loss.
            image: [H, W, 3] render of the view, unclamped.
            view: The view of this step.
        """
        del image, view
        return loss

    def after_backward(self, view: TrainingView, gaussians: Gaussians) -> None:
        """Change gradients in place, after backward and before the optimizer.

        Args:
            view: The view of this step.
            gaussians: Whose parameters hold the gradients.
        """


class Components(tuple[Component, ...]):
    """The components that are on, in the order that their hooks run; none is the baseline."""

    __slots__ = ()

    def loss(self, loss: Tensor, image: Tensor, view: TrainingView) -> Tensor:
        """`Component.loss` of each in turn; the very `loss` given where none is on."""
        for component in self:
            loss = component.loss(loss, image, view)
        return loss

    def after_backward(self, view: TrainingView, gaussians: Gaussians) -> None:
        """`Component.after_backward` of each in turn."""
        for component in self:
            component.after_backward(view, gaussians)


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
        XrgsError: A value is out of its range, or a view is too small for its paired target.
    """
    _not_negative("components.loss_weighting.lr_weight", conf.loss_weighting.lr_weight)
    _not_negative("components.gradient_scaling.lr_scale", conf.gradient_scaling.lr_scale)
    for name in ("weight", "l1", "ssim"):
        _not_negative(f"components.consistency.{name}", getattr(conf.consistency, name))
    components: list[Component] = []
    if conf.consistency.weight != 0:
        components.append(Consistency(conf.consistency, views, factor, backend))
    # After consistency: a view's weight multiplies its consistency loss too, which would otherwise
    # give back to LR views what weighting took from them.
    if conf.loss_weighting.lr_weight != 1:
        components.append(LossWeighting(conf.loss_weighting))
    if conf.gradient_scaling.lr_scale != 1:
        components.append(GradientScaling(conf.gradient_scaling))
    return Components(components)


class LossWeighting(Component):
    """Resolution-aware loss weighting (paper 5.2): the whole loss of an LR view x `lr_weight`.

    It scales the view's image-plane gradients too, and so changes what is densified.
    """

    def __init__(self, conf: LossWeightingConf) -> None:
        self.lr_weight = conf.lr_weight

    def loss(self, loss: Tensor, image: Tensor, view: TrainingView) -> Tensor:
        """`loss * lr_weight` in an LR view."""
        del image
        return loss * self.lr_weight if view.tag == "LR" else loss


class GradientScaling(Component):
    """Gradient scaling for Gaussian radii (paper 5.3): LR views move the scales less.

    Only the gradient of the log-scales is touched: not means, quaternions, opacities or colours,
    nor the image-plane gradient that densification reads.
    """

    def __init__(self, conf: GradientScalingConf) -> None:
        self.lr_scale = conf.lr_scale

    def after_backward(self, view: TrainingView, gaussians: Gaussians) -> None:
        """`scales.grad * lr_scale` in an LR view."""
        if view.tag == "LR" and gaussians.scales.grad is not None:
            gaussians.scales.grad.mul_(self.lr_scale)


class Consistency(Component):
    """Cross-resolution consistency (paper 5.6): the render must agree at the other resolution too.

    `loss + weight * (l1 * |phi(render) - pair|_1 + ssim * (1 - SSIM(phi(render), pair)))`, where
    `pair` is phi of the photograph, made once here and kept: of an HR view `factor` times smaller,
    of an LR view `factor` times larger. phi is antialiased bicubic to an exact size, unclamped.

    phi is linear: phi(render) - phi(photograph) = phi(render - photograph). An LR view's branch
    therefore knows nothing that the photometric loss doesn't, and costs factor^2 times the pixels.
    `lr_mode` chooses: `exact` does it as the paper has it; `off` leaves LR views alone; `fold`
    takes phi for an isometry of L1 and adds `weight * l1 * mean |render - photograph|` at the
    view's own size, which is what a larger weight of the photometric L1 would be, and leaves the
    SSIM part out. phi's rows sum to 1 and its columns to factor^2 (to 3 % at a corner), so the two
    are equal where the error keeps its sign. Elsewhere `fold` is more than the exact L1 where signs
    alternate from pixel to pixel and phi averages them out (1.23 times for white noise, factor 5),
    and never less than 0.7 of it, since absolute columns sum to at most 1.19 factor an axis.
    """

    def __init__(
        self,
        conf: ConsistencyConf,
        views: Sequence[TrainingView],
        factor: int,
        backend: str = "torch",
    ) -> None:
        if conf.lr_mode not in {"exact", "fold", "off"}:
            raise XrgsError(
                f"components.consistency.lr_mode={conf.lr_mode}: must be exact, fold or off"
            )
        self.weight, self.l1, self.ssim = conf.weight, conf.l1, conf.ssim
        self.lr_mode = conf.lr_mode
        self.backend = backend
        self.pairs = {
            view.name: _pair(view, factor)
            for view in views
            if view.tag == "HR" or conf.lr_mode == "exact"
        }

    def loss(self, loss: Tensor, image: Tensor, view: TrainingView) -> Tensor:
        """`loss` and the view's consistency."""
        if view.tag == "HR" or self.lr_mode == "exact":
            pair = self.pairs[view.name]
            height, width = pair.image.shape[:2]
            projected = resize(image, height, width, backend=self.backend)
            consistency = photometric_loss(
                projected, pair, l1=self.l1, ssim=self.ssim, backend=self.backend
            )
            return loss + self.weight * consistency
        if self.lr_mode == "fold":
            return loss + self.weight * self.l1 * (image - view.image).abs().mean()
        return loss


def _pair(view: TrainingView, factor: int) -> Target:
    """The view's photograph at the opposite resolution."""
    height, width = view.image.shape[:2]
    if view.tag == "HR":
        height, width = round(height / factor), round(width / factor)
    else:
        height, width = height * factor, width * factor
    if min(height, width) < WINDOW:
        raise XrgsError(
            f"variant.factor={factor}: view {view.name} at its low resolution is {width} x {height}"
            f" px, smaller than the SSIM window of {WINDOW} px of the consistency loss"
        )
    return prepare_target(resize(view.image, height, width))


def _not_negative(key: str, value: float) -> None:
    if not (math.isfinite(value) and value >= 0):
        raise XrgsError(f"{key}={value}: must be a finite number, 0 or more")
