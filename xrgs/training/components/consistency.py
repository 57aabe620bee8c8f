"""Cross-resolution consistency (paper 5.6)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

from torch import Tensor

from xrgs.errors import XrgsError
from xrgs.splat.loss import WINDOW, Target, photometric_loss, prepare_target
from xrgs.splat.resample import resize
from xrgs.training.components.base import Component, Step, TrainingView

if TYPE_CHECKING:  # xrgs.config loads Hydra, which training does without
    from xrgs.config import ConsistencyConf


class Consistency(Component):
    """Cross-resolution consistency (paper 5.6): the render must agree at the other resolution too.

    `loss + weight * (l1 * |phi(render) - pair|_1 + ssim * (1 - SSIM(phi(render), pair)))`, where
    `pair` is phi of the photograph, made once here and kept: of an HR view `factor` times smaller,
    of an LR view `factor` times larger. phi is antialiased bicubic to an exact size, unclamped.
    An LR view that is not small (zoomed, compressed, or tagged by what it shows) has its other
    resolution below it, too: its longer side is nearer to the HR views' than to 1 / `factor` of it.

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
        largest = max((max(v.image.shape) for v in views if v.tag == "HR"), default=math.inf)
        self.pairs = {
            view.name: _pair(view, factor, largest)
            for view in views
            if view.tag == "HR" or conf.lr_mode == "exact"
        }

    def loss(self, loss: Tensor, image: Tensor, step: Step) -> Tensor:
        """`loss` and the view's consistency."""
        added = self._of(image, step.view)
        if added is None:
            return loss
        step.log[f"consistency.{step.view.tag}"] = added.item()
        return loss + added

    def _of(self, image: Tensor, view: TrainingView) -> Tensor | None:
        """Scalar; None where the view has none."""
        if view.tag == "HR" or self.lr_mode == "exact":
            pair = self.pairs[view.name]
            height, width = pair.image.shape[:2]
            projected = resize(image, height, width, backend=self.backend)
            # Its weight goes into the loss's own: a factor outside is one more pass over the image.
            l1, ssim = self.weight * self.l1, self.weight * self.ssim
            return photometric_loss(projected, pair, l1=l1, ssim=ssim, backend=self.backend)
        if self.lr_mode == "fold":
            return self.weight * self.l1 * (image - view.image).abs().mean()
        return None


def _pair(view: TrainingView, factor: int, largest: float) -> Target:
    """The view's photograph at the opposite resolution; `largest` is the HR views' longest side."""
    height, width = view.image.shape[:2]
    if view.tag == "HR" or max(height, width) > largest / math.sqrt(factor):
        height, width = round(height / factor), round(width / factor)
    else:
        height, width = height * factor, width * factor
    if min(height, width) < WINDOW:
        raise XrgsError(
            f"variant.factor={factor}: view {view.name} at its low resolution is {width} x {height}"
            f" px, smaller than the SSIM window of {WINDOW} px of the consistency loss"
        )
    return prepare_target(resize(view.image, height, width))
