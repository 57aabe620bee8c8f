"""The 3D smoothing filter of Mip-Splatting, at the rate that mixed resolution asks for."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from xrgs.training.components.base import Component, Step, TrainingView

if TYPE_CHECKING:  # xrgs.config loads Hydra, which training does without
    from xrgs.config import MipConf
    from xrgs.splat.cameras import Camera
    from xrgs.splat.gaussians import ActivatedGaussians, Gaussians

MARGIN = 0.15
"""Share of the image's size by which a centre may lie outside and still count as seen."""


class Mip(Component):
    """No Gaussian is smaller than the finest of the training views that see it can tell.

    Mip-Splatting (Yu et al. 2024, 4.1): each Gaussian is rendered convolved with an isotropic one
    of variance `variance / nu^2`, which is added to its squared scales, and its opacity takes the
    root of the ratio of the determinants, so that its mass stays. nu, in pixels a world unit, is
    the highest rate f_i / z_i of a view i that sees it. Its authors' code divides the largest focal
    length of all views by the nearest distance, which is the same where all focal lengths are; with
    LR and HR views it pairs one view's distance with another's focal length.

    The rates are found anew whenever Gaussians came or went, and every `every` steps, as means move
    (their code does both, the second once densification is over). A Gaussian that no view sees
    takes the coarsest rate of those that are seen, as there; where none is seen there is no filter.
    Densification reads the parameters without the filter, as there; `finish` bakes it in.
    """

    def __init__(self, conf: MipConf, views: Sequence[TrainingView], near: float) -> None:
        self.strength, self.every = conf.variance, conf.every
        self.cameras = [view.camera for view in views]
        self.near = near
        self.variance = torch.empty(0)  # [N] world units^2, of the Gaussians as they are
        self.unseen = 0

    def on_gaussians_changed(self, gaussians: Gaussians) -> None:
        """Rates of the Gaussians as they are now."""
        self._measure(gaussians.means)

    def activated(self, activated: ActivatedGaussians, step: Step) -> ActivatedGaussians:
        """Gaussians with the filter, differentiable in scales and opacities; it is a constant."""
        if step.number % self.every == 0:
            self._measure(activated.means)
            step.log["mip.sigma"] = self.variance.sqrt().mean().item()
            step.log["mip.unseen"] = self.unseen
        scales, opacities = smoothed(activated.scales, activated.opacities, self.variance)
        return activated._replace(scales=scales, opacities=opacities)

    @torch.no_grad()
    def finish(self, gaussians: Gaussians) -> None:
        """The filter becomes part of scales and opacities: what is kept is what was trained."""
        activated = gaussians.activated()
        scales, opacities = smoothed(
            activated.scales.double(), activated.opacities.double(), self.variance.double()
        )
        # An opacity that left the range of float32 must not become an infinite logit.
        bounds = torch.finfo(torch.float32)
        logits = torch.logit(opacities.clamp(bounds.tiny, 1 - bounds.eps))
        gaussians.scales = scales.log().to(gaussians.scales).requires_grad_()
        gaussians.opacities = logits.to(gaussians.opacities).requires_grad_()

    def state_dict(self) -> dict[str, Any]:
        """The filter: it is of the means as they were when they were last measured."""
        return {"variance": self.variance}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """The filter that `state_dict` told of."""
        self.variance = state["variance"]

    def _measure(self, means: Tensor) -> None:
        rate = sampling_rates(means.detach(), self.cameras, self.near)
        seen = rate > 0
        self.unseen = int((~seen).sum())
        coarsest = rate[seen].min() if seen.any() else rate.new_tensor(torch.inf)
        variance = self.strength / torch.where(seen, rate, coarsest).square()
        self.variance = variance.clamp_min(torch.finfo(variance.dtype).tiny)  # else 0 / 0


def smoothed(scales: Tensor, opacities: Tensor, variance: Tensor) -> tuple[Tensor, Tensor]:
    """Gaussians convolved with an isotropic one of equal mass.

    Args:
        scales: [N, 3] world units, above 0.
        opacities: [N]
        variance: [N] world units^2.

    Returns:
        `sqrt(scales^2 + variance)`, and `opacities` times the root of the covariances'
        determinants' ratio.
    """
    wider = torch.sqrt(scales * scales + variance[:, None])
    # A ratio an axis, since a product of three small scales underflows.
    ratio = scales / wider
    return wider, opacities * ratio[:, 0] * ratio[:, 1] * ratio[:, 2]


def sampling_rates(means: Tensor, cameras: Sequence[Camera], near: float) -> Tensor:
    """Pixels a world unit at which the finest view that sees each point samples it.

    A view sees a point whose depth is above `near` and that falls on the image or within 15 % of
    its size beside it. Of fx and fy the larger counts.

    Args:
        means: [N, 3] world units.
        cameras: Of the views.
        near: World units.

    Returns:
        [N], 0 where no view sees the point.
    """
    finest = means.new_zeros(len(means))
    for camera in cameras:
        viewmat, K = camera.viewmat.to(means), camera.K.to(means)
        size = means.new_tensor([camera.width, camera.height])
        # Homogeneous pixels: compared before the division by depth, which may be 0.
        projected = torch.addmm(K @ viewmat[:3, 3], means, (K @ viewmat[:3, :3]).T)  # [N, 3]
        depth = projected[:, 2:]
        flat = projected[:, :2]
        seen = (depth > near) & (flat >= -MARGIN * size * depth)
        seen &= flat <= (1 + MARGIN) * size * depth
        rate = torch.maximum(K[0, 0], K[1, 1]) / depth[:, 0]
        finest = torch.where(seen.all(dim=-1), torch.maximum(finest, rate), finest)
    return finest
