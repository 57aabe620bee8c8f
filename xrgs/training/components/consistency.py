"""Cross-resolution consistency loss [xrgs, section 5.6]."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Self

import torch
from torch import Tensor

from xrgs.errors import XrgsError
from xrgs.splat.loss import WINDOW, Target, photometric_loss, prepare_target
from xrgs.splat.resample import resize
from xrgs.training.components.base import Component, Step, TrainingSetup, TrainingView
from xrgs.training.memory import OnDemand

if TYPE_CHECKING:
    from xrgs.config import ConsistencyConf
    from xrgs.splat.gaussians import Gaussians


class Consistency(Component):
    """Compares render and photograph also at the opposite resolution, LR for HR and vice versa.

    Section 5.6 of the paper adds to the loss of every view

        L_cons = w (lambda_1 |phi(I_rend) - I_pair|_1 + lambda_2 (1 - SSIM(phi(I_rend), I_pair)))

    where phi is bicubic resampling to the opposite resolution and I_pair = phi(I) is the paired
    image of photograph I. Here w is `weight`, lambda_1 is `l1` and lambda_2 is
    `ssim`; the L1 term is a mean over pixels and channels, SSIM is as in the photometric loss
    [wang2004].

    Our choice where the paper is silent:

    - w is 0.1 in `conf/ablation/consistency.yaml`, lambda_1 0.8 and lambda_2 0.2, as in the
      photometric loss.
    - phi is antialiased and not clamped, and resamples to an exact size in pixels: `factor` times
      smaller for an HR view, `factor` times larger for an LR view.
    - The view's weight multiplies L_cons too (`xrgs.training.components.weighting`). Otherwise this
      term would undo the weighting of LR views.
    - An LR view is downsampled like an HR view if its longer side is closer to that of the HR views
      than to 1 / `factor` of it: such LR views are zoomed digitally, compressed, or tagged by
      distance.

    phi is linear: phi(I_rend) - phi(I) = phi(I_rend - I). So for an LR view the term adds no
    information to the photometric loss, and costs factor^2 times as many pixels. `lr_mode` chooses
    the term of LR views:

    - `exact`: the paper's term.
    - `off`: no term.
    - `fold`: `weight * l1 * mean |I_rend - I|` at the view's size, without SSIM. It equals the
      exact L1 term where the error has a constant sign, since the rows of phi sum to 1 and its
      columns to factor^2 (to 3% at a corner). It is larger where signs alternate from pixel to
      pixel and phi averages them out (1.23 times for white noise at factor 5). It is at least 0.7
      times the exact term, since the absolute columns sum to at most 1.19 factor along an axis.
    """

    def __init__(
        self,
        settings: ConsistencyConf,
        views: Sequence[TrainingView],
        factor: int,
        backend: str = "torch",
    ) -> None:
        self.weight, self.l1, self.ssim = settings.weight, settings.l1, settings.ssim
        self.lr_mode, self.backend = settings.lr_mode, backend
        hr_sides = (
            max(view.camera.width, view.camera.height) for view in views if view.tag == "HR"
        )
        hr_long_side = max(hr_sides, default=math.inf)
        paired = [view for view in views if view.tag == "HR" or settings.lr_mode == "exact"]
        self.sizes = {view.name: _opposite_size(view, factor, hr_long_side) for view in paired}
        self.paired_targets = OnDemand(self._paired_target, paired)

    @classmethod
    def from_settings(cls, settings: ConsistencyConf, setup: TrainingSetup) -> Self:
        """Build the component; XrgsError if a paired image is smaller than the SSIM window."""
        return cls(settings, setup.data.train, setup.data.factor, setup.backend)

    def modify_loss(self, loss: Tensor, image: Tensor, gaussians: Gaussians, step: Step) -> Tensor:
        """Return `loss + L_cons`, and record L_cons as `consistency.<tag>`."""
        view = step.view
        if view.tag == "HR" or self.lr_mode == "exact":
            target = self.paired_targets[view.name]
            height, width = target.image.shape[:2]
            projected = resize(image, height, width, backend=self.backend)
            # Multiplying the result by the weight would be one more pass over the image.
            l1, ssim = self.weight * self.l1, self.weight * self.ssim
            added = photometric_loss(projected, target, l1=l1, ssim=ssim, backend=self.backend)
        elif self.lr_mode == "fold":
            # In double, where only digits below float32's precision depend on the thread count.
            difference = (image - view.image).abs().mean(dtype=torch.float64)
            added = self.weight * self.l1 * difference.to(image)
        else:
            return loss
        step.log[f"consistency.{view.tag}"] = added.item()
        return loss + added

    def _paired_target(self, view: TrainingView) -> Target:
        """Resample the photograph of a view to the opposite resolution."""
        image = resize(view.image, *self.sizes[view.name], backend=self.backend)
        return prepare_target(image, backend=self.backend)


def _opposite_size(view: TrainingView, factor: int, hr_long_side: float) -> tuple[int, int]:
    """Return height and width of the paired image; `hr_long_side` is the largest HR view's, px."""
    height, width = view.camera.height, view.camera.width
    if view.tag == "HR" or max(height, width) > hr_long_side / math.sqrt(factor):
        height, width = round(height / factor), round(width / factor)
    else:
        height, width = height * factor, width * factor
    if min(height, width) < WINDOW:
        raise XrgsError(
            f"variant.factor={factor}: view {view.name} at its low resolution is {width} x {height}"
            f" px, smaller than the SSIM window of {WINDOW} px of the consistency loss; use larger"
            " photographs or a smaller factor"
        )
    return height, width
