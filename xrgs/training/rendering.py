"""Renders training views as a training step does, with all components."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from xrgs.splat.rendering import Render, attribute_pixels, rasterize_parameters

if TYPE_CHECKING:
    from xrgs.splat.cameras import Camera
    from xrgs.splat.gaussians import ActivatedGaussians, Gaussians
    from xrgs.splat.settings import RasterSettings
    from xrgs.training.components import Components, Step
    from xrgs.training.recorder import TrainingRecorder


def inside_mask(image: Tensor, photograph: Tensor, mask: Tensor | None) -> Tensor:
    """Replace the pixels of a render outside the mask by those of the photograph.

    So they have no loss and no gradient. SSIM windows across the border of the mask compare equal
    pixels outside it. The loss remains a mean over all pixels, and used pixels have the same
    gradients as without a mask. Images are [H, W, 3], the mask [H, W] is True for a used pixel.
    """
    return image if mask is None else image.where(mask[..., None], photograph)


@dataclass(frozen=True)
class StepRenderer:
    """Renders any training view as a step on that view does, with all components.

    Components get it before the first step (`Component.before_training`). The alpha evaluations of
    `photograph` and `attribute` are added to those of the run.
    """

    components: Components
    raster: RasterSettings
    sh_every: int
    """Steps of this run between the activations of two bands of the spherical harmonics."""
    backend: str
    """`torch` or `native`."""
    recorder: TrainingRecorder

    def sh_degree(self, step: Step) -> int:
        """Return the highest band of the spherical harmonics that is on at a step."""
        return min(step.number // self.sh_every, self.raster.sh_degree)

    def render(
        self, gaussians: Gaussians, step: Step, camera: Camera, means2d_offset: Tensor | None = None
    ) -> Render:
        """Render the step's view, differentiable in the N Gaussians.

        `camera` is the view's after the components' `render_camera`; `means2d_offset` [N, 2] is as
        for `rasterize_parameters`. The alpha evaluations are not yet counted.
        """
        raw = not self.components.override("before_render")
        return rasterize_parameters(
            *(gaussians.raw() if raw else self._activated(gaussians, step)),
            camera,
            self.raster,
            sh_degree=self.sh_degree(step),
            means2d_offset=means2d_offset,
            raw=raw,
            backend=self.backend,
        )

    def _activated(self, gaussians: Gaussians, step: Step) -> ActivatedGaussians:
        """Return the activated Gaussians after the components' `before_render`."""
        return self.components.before_render(gaussians.activated(backend=self.backend), step)

    @torch.no_grad()
    def photograph(self, gaussians: Gaussians, step: Step) -> Tensor:
        """Render the step's view as for the loss; outside the mask it is the photograph.

        The image is at the photograph's size, not clamped to 0..1.
        """
        camera = self.components.render_camera(step.view.camera, step)
        render = self.render(gaussians, step, camera)
        self.recorder.record_evaluations(render.evaluations)
        image, view = self.components.to_photograph(render.image, step), step.view
        image = self.components.match_colors(image, step)
        return image if view.mask is None else inside_mask(image, view.image, view.mask)

    @torch.no_grad()
    def attribute(self, pixels: Tensor, gaussians: Gaussians, step: Step) -> Tensor:
        """Sum a map over the view's photograph for each Gaussian, by its blending weights.

        As `attribute_pixels`, with the map [H, W] and the blending weights at the photograph's
        size. `to_photograph` is linear, so the transpose of it is applied to the map instead.

        Returns:
            Sums [N], in the unit of the map times px of the photograph.
        """
        camera = self.components.render_camera(step.view.camera, step)
        with torch.enable_grad():
            probe = pixels.new_zeros(camera.height, camera.width, 3).requires_grad_()
            formed = self.components.to_photograph(probe, step)
            (transposed,) = torch.autograd.grad((formed[..., 0] * pixels).sum(), probe)
        activated = self._activated(gaussians, step)
        found = attribute_pixels(
            transposed[..., 0], activated, camera, self.raster, backend=self.backend
        )
        self.recorder.record_evaluations(found.evaluations)
        return found.sums
