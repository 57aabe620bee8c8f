"""The 3D smoothing filter of Mip-Splatting [yu2024], for views of mixed resolution."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import zip_longest
from typing import TYPE_CHECKING, Any, Self

import torch
from torch import Tensor

from xrgs.splat.rounding import rounded_mean, rounded_sqrt
from xrgs.training.components.base import Component, Step, TrainingSetup, TrainingView

if TYPE_CHECKING:
    from xrgs.config import MipConf
    from xrgs.splat.cameras import Camera
    from xrgs.splat.gaussians import ActivatedGaussians, Gaussians

MARGIN = 0.15
"""Fraction of the image's size by which a Gaussian's mean may lie outside and still count as
seen."""


class Mip(Component):
    """Limits the detail of each Gaussian to the resolution of the finest view that sees it.

    Mip-Splatting [yu2024, section 4.1] renders each Gaussian k convolved with an isotropic
    Gaussian, the 3D smoothing filter:

        Sigma_k <- Sigma_k + (s / nu_k^2) I,
        o_k <- o_k sqrt(|Sigma_k| / |Sigma_k + (s / nu_k^2) I|)

    so that its integral is unchanged. nu_k, in px per world unit, is the highest sampling rate
    f_i / z_ik of the views i that see the Gaussian, with focal length f_i in px and depth z_ik in
    world units. s is `variance`, in px^2; Mip-Splatting's is 0.2. Visibility is tested with a
    margin of 15% of the image, as in the authors' code.

    Our choice for mixed resolution: nu_k is the maximum of f_i / z_ik over the views. The authors'
    code divides the largest focal length of all views by the nearest distance, which is the same
    only if all focal lengths are equal: with LR and HR views it may combine the distance of one
    view with the focal length of another. The XR-GS paper has no such filter.

    The rates are computed anew after Gaussians were added or removed, and every `every` steps,
    since means move; the authors' code does the latter only after densification. As in that code, a
    Gaussian that no view sees gets the lowest rate of the seen Gaussians, densification reads the
    parameters without the filter, and a reset caps the opacities with the filter. If no Gaussian is
    seen, there is no filter. Evaluated and saved scales and opacities include the filter.

    The rates are those of the photographs, also with `supersampled`, `formation` and
    `resolution_schedule`, which render at other sizes.

    Attributes:
        variance: [N] variance of each Gaussian's filter, s / nu_k^2, in world units squared.
        unseen_count: The number of Gaussians that no view sees.
    """

    def __init__(self, settings: MipConf, views: Sequence[TrainingView], near: float) -> None:
        """Store cameras and masks; `near` is the depth below which nothing is rendered."""
        self.strength, self.every = settings.variance, settings.every
        self.cameras = [view.camera for view in views]
        self.masks = [view.mask for view in views]
        self.near = near
        self.variance = torch.empty(0)
        self.unseen_count = 0

    @classmethod
    def from_settings(cls, settings: MipConf, setup: TrainingSetup) -> Self:
        """Build the component."""
        return cls(settings, setup.data.train, setup.splat.raster.near)

    def opacity_attenuation(self, gaussians: Gaussians) -> Tensor | None:
        """Return the factors [N] by which the filter lowers the opacities."""
        self._update_variance(gaussians.means)
        # In double, since the last digits in float32 depend on the processor.
        scales = gaussians.scales.detach().double().exp()
        _, lowered = smooth(scales, scales.new_ones(len(scales)), self.variance.double())
        return lowered

    def on_gaussians_changed(self, gaussians: Gaussians) -> None:
        """Compute the filter for the present Gaussians."""
        self._update_variance(gaussians.means)

    def before_render(self, activated: ActivatedGaussians, step: Step) -> ActivatedGaussians:
        """Apply the filter to scales and opacities; it is a constant for the gradients.

        `mip.sigma` records the mean standard deviation, in world units, and `mip.unseen` the number
        of Gaussians that no view sees.
        """
        if step.number % self.every == 0:
            self._update_variance(activated.means)
            step.log["mip.sigma"] = rounded_mean(rounded_sqrt(self.variance))
            step.log["mip.unseen"] = self.unseen_count
        scales, opacities = smooth(activated.scales, activated.opacities, self.variance)
        return activated._replace(scales=scales, opacities=opacities)

    @torch.no_grad()
    def bake(self, gaussians: Gaussians) -> None:
        """Apply the filter to the scales and opacities."""
        # In double, since the last digits in float32 depend on the processor.
        scales, opacities = smooth(
            gaussians.scales.double().exp(),
            gaussians.opacities.double().sigmoid(),
            self.variance.double(),
        )
        # Clamped so that no logit is infinite in float32.
        bounds = torch.finfo(torch.float32)
        logits = torch.logit(opacities.clamp(bounds.tiny, 1 - bounds.eps))
        # In place, so that the optimizer keeps its tensors and their moments.
        gaussians.scales.copy_(scales.log())
        gaussians.opacities.copy_(logits)

    def state_dict(self) -> dict[str, Any]:
        """Return the filter, which is not recomputed from the present means."""
        return {"variance": self.variance}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore a state of `state_dict`."""
        self.variance = state["variance"].to(self.variance.device)

    def _update_variance(self, means: Tensor) -> None:
        rates = sampling_rates(means.detach(), self.cameras, self.near, self.masks)
        seen = rates > 0
        self.unseen_count = int((~seen).sum())
        lowest = rates[seen].min() if seen.any() else rates.new_tensor(torch.inf)
        variance = self.strength / torch.where(seen, rates, lowest).square()
        # Above 0, since `smooth` would compute 0 / 0 for a scale of 0.
        self.variance = variance.clamp_min(torch.finfo(variance.dtype).tiny)


def smooth(scales: Tensor, opacities: Tensor, variance: Tensor) -> tuple[Tensor, Tensor]:
    """Convolve Gaussians with isotropic ones, with the same integrals [yu2024, section 4.1].

    Args:
        scales: [N, 3] standard deviations in world units, above 0.
        opacities: [N] in 0..1.
        variance: [N] variances of the isotropic Gaussians, in world units squared.

    Returns:
        Scales [N, 3], `sqrt(scales^2 + variance)`, and opacities [N], multiplied by the square root
        of the determinant of the covariance before over that after.
    """
    wider = rounded_sqrt(scales * scales + variance[:, None])
    # Ratios of single axes, since the product of three small scales underflows.
    ratio = scales / wider
    return wider, opacities * ratio[:, 0] * ratio[:, 1] * ratio[:, 2]


def sampling_rates(
    means: Tensor, cameras: Sequence[Camera], near: float, masks: Sequence[Tensor | None] = ()
) -> Tensor:
    """Compute the highest sampling rate of each point [N, 3] among the views that see it.

    A view sees a point if its depth is above `near`, world units, its projection lies inside the
    image or within 15% of the image's size outside it, and the nearest pixel is used by the view's
    mask [H, W], if it has one. The rate is the larger of fx and fy over the depth.

    Returns:
        [N] rates in px per world unit, 0 if no view sees the point.
    """
    highest = means.new_zeros(len(means))
    for camera, mask in zip_longest(cameras, masks):
        K = camera.K.to(means)
        x, y, depth, seen = camera.in_image(means, near=near, margin=MARGIN)  # [N] each
        if mask is not None:
            seen[seen.clone()] = _shown(mask, K, x[seen], y[seen], depth[seen])
        rate = torch.maximum(K[0, 0], K[1, 1]) / depth
        highest = torch.where(seen, torch.maximum(highest, rate), highest)
    return highest


def _shown(mask: Tensor, K: Tensor, x: Tensor, y: Tensor, depth: Tensor) -> Tensor:
    """Return for each of N projected points whether the mask uses the nearest pixel."""
    row, column = (
        (K[axis, axis] * place / depth + K[axis, 2]).floor().long().clamp(0, size - 1)
        for axis, place, size in ((1, y, mask.shape[0]), (0, x, mask.shape[1]))
    )
    return mask[row, column]
