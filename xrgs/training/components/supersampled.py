"""Rendering of coarse views at a larger size, then downsampling as the photograph was.

`components.formation` trains the blur of LR photographs (`BlurWidths`).
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Self

import torch
from torch import Tensor

from xrgs.splat.cameras import Camera
from xrgs.splat.resample import resize
from xrgs.training.components.adam import RowAdam
from xrgs.training.components.base import Component, Step, TrainingSetup, TrainingView

if TYPE_CHECKING:
    from xrgs.config import FormationConf, SupersampledConf
    from xrgs.splat.gaussians import Gaussians


BOX = math.sqrt(1 / 12)
"""Standard deviation of a box of one pixel, px: the least blur, by the area of a sensor's pixel."""


class BlurWidths(RowAdam):
    """The standard deviations, along y and x, of the blur of LR photographs, which are trained.

    A photograph is blurred by the lens, by motion and by the area of its pixels, all of them
    unknown. The render S of a view, k times as large as the photograph, is downsampled by

        D(S) = R G(sigma) S,

    where R is the antialiased bicubic resampling of `supersampled`, and G(sigma) a Gaussian blur
    with a standard deviation for each axis, in px of the photograph (`xrgs.splat.resample.resize`).
    The second moment of R's kernel is 0, so sigma is nearly the whole blur of the photograph. For
    example, a Gaussian of 0.8 px and the box of a pixel, 0.85 px together, give a sigma of 0.83 px.
    R damps the highest frequencies like the box, so for the box without other blur sigma goes to 0.

    Each sigma starts at the box of a pixel, sqrt(1/12) px. Adam [kingma2015] trains its logarithm
    at the rate `lr`, with `prior` times the square of log(sigma / box) in the loss. The prior
    decides where the photographs do not. With `widths=tag` all LR views share a pair of widths;
    with `widths=view` each LR view has its own, updated only at its steps. HR views have none:
    otherwise Gaussians and widths could become sharper together.

    BAGS [peng2024] trains a network for a kernel at each pixel; one Gaussian for all views, its
    start and its prior are our choice.

    `formation.sigma_x` and `formation.sigma_y` record the widths of the step's view along x and y.
    The rows of `values` are natural logarithms of the widths along y and x [R, 2].
    """

    def __init__(self, settings: FormationConf, views: Sequence[TrainingView]) -> None:
        """Start with the box of a pixel for each of the LR training views."""
        self.settings = settings
        shared = settings.widths == "tag"
        self.rows = {view.name: 0 if shared else row for row, view in enumerate(views)}
        """View name -> row of its widths in `values`."""
        count = len(set(self.rows.values()))
        super().__init__(torch.full((count, 2), math.log(BOX), dtype=torch.float64))
        self.drawn: Tensor | None = None
        """Log widths of the step's view [2], on which the gradient accumulates."""

    def of(self, name: str) -> tuple[float, float]:
        """Return the widths of a view along y and x, px of its photograph."""
        down, across = self.values[self.rows[name]].exp().float().tolist()
        return down, across

    def variances(self, step: Step, factor: int) -> Tensor:
        """Return the variances [2] of the blur of the step's view, px^2 of its render.

        Args:
            step: The step, on an LR view. If gradients are enabled, its log records the widths.
            factor: Size of the render over the size of the photograph.
        """
        logs = self.values[self.rows[step.view.name]].clone()
        if torch.is_grad_enabled():  # not for other components' renders
            self.drawn = logs.requires_grad_()
            step.log["formation.sigma_y"], step.log["formation.sigma_x"] = self.of(step.view.name)
        return (factor * logs.exp()).square()

    def learn(self, step: Step) -> None:
        """Update the widths of the step's view, after the backward pass."""
        if self.drawn is None or self.drawn.grad is None:
            return
        logs = self.drawn.detach()
        # Rounded: the last digits of a sum in double depend on the processor.
        gradient = self.drawn.grad.float().double()
        gradient += 2 * self.settings.prior * (logs - math.log(BOX))
        self.update(self.rows[step.view.name], gradient, self.settings.lr)
        self.drawn = None

    def findings(self) -> list[str]:
        """Return a line with the widths; with `widths=view`, with the smallest and the largest."""
        if not self.rows:
            return []
        blurs = {name: math.hypot(*self.of(name)) / math.sqrt(2) for name in self.rows}
        low, high = min(blurs, key=lambda n: blurs[n]), max(blurs, key=lambda n: blurs[n])
        if self.settings.widths == "tag":
            down, across = self.of(low)
            return [f"formation: LR views: {across:.2f} px of blur across, {down:.2f} down"]
        return [
            f"formation: LR views: {blurs[low]:.2f} px of blur ({low}) to {blurs[high]:.2f} px"
            f" ({high})"
        ]


class Supersampled(Component):
    """Renders coarse views at a larger size, and downsamples the render as the photograph was.

    The photograph of a coarse view is I = D(S): a finer image S of the same camera, downsampled by
    a kernel D. gsplat [ye2025] renders the view at the size of I, where the dilation
    `splat.raster.eps2d` of 0.3 px^2 is a large area in pixels of a finer view. Here view v is
    rendered at k_v times the width and height, and its loss is

        L(D(render_k), I),    k_v = clamp(round(need_v), 1, factor).

    need_v is the factor of width and height at which the view would be as fine as the finest views
    of the same content (`xrgs.mixture.sampling_rate.needed_factors`): about 1 for an HR view, and
    about `variant.factor` for a degraded view. The tag does not matter: if all photographs have
    nearly the same resolution, all are rendered at their own size.

    D is the kernel that made the variant's LR views:

    - `downsample`, and other degradations to a smaller size: antialiased bicubic to the size of I;
    - `digital_zoom`: the same to the intermediate size, which is the resolution of I, then bicubic
      upsampling; the render is k times as large as the intermediate size.

    For all other views D is the mean of k x k pixels, since a pixel of a sensor averages over its
    area.

    With `components.formation`, D is trained for LR views instead (`BlurWidths`), also for k = 1; a
    digital zoom is applied after it.

    From step `late_from` on, `late_factor` replaces `factor`, so that a run may begin or end with
    renders at the photographs' size. Densification reads image-plane gradients in normalised device
    units, which do not depend on the size of the render. The evaluation is not changed.

    Our choice: the whole component. Super-resolution of 3D Gaussian Splatting also trains through a
    downsampled render [feng2024srgs], but only on LR views.
    """

    def __init__(
        self,
        settings: SupersampledConf,
        views: Sequence[TrainingView],
        degradation: str,
        zoom: int,
        backend: str = "torch",
        *,
        blur: FormationConf,
    ) -> None:
        """Choose the kernels D.

        `zoom` is the factor of the digital zoom: size of a photograph over its resolution.
        """
        self.settings, self.backend = settings, backend
        self.shrinks = degradation not in ("jpeg", "none")
        """Whether the degradation reduces the resolution of LR views."""
        self.zoom = zoom if degradation == "digital_zoom" else 1
        low = [view for view in views if view.tag == "LR"]
        self.blur = BlurWidths(blur, low) if blur.widths != "none" else None
        self.needs = [view.supersampling for view in views]

    @classmethod
    def from_settings(cls, settings: SupersampledConf, setup: TrainingSetup) -> Self:
        """Build the component."""
        data, blur = setup.data, setup.components.formation
        return cls(settings, data.train, data.degradation, data.factor, setup.backend, blur=blur)

    def render_camera(self, camera: Camera, step: Step) -> Camera:
        """Return the camera at k times the photograph's resolution."""
        factor = self._factor(step)
        if factor == 1 and self._blur_of(step) is None:
            return camera
        step.log["supersampled.factor"] = factor
        small = self._resolved(camera, step)
        return small.resized(small.width * factor, small.height * factor)

    def to_photograph(self, image: Tensor, step: Step) -> Tensor:
        """Downsample the render [kH, kW, 3] of a view to its photograph's size [H, W, 3]."""
        factor, blur = self._factor(step), self._blur_of(step)
        if factor == 1 and blur is None:
            return image
        if blur is None and not (self.shrinks and step.view.tag == "LR"):
            return _block_means(image, factor)
        camera = step.view.camera
        small = self._resolved(camera, step)
        variances = None if blur is None else blur.variances(step, factor)
        image = resize(image, small.height, small.width, variances=variances, backend=self.backend)
        if (camera.height, camera.width) == (small.height, small.width):
            return image
        return resize(image, camera.height, camera.width, backend=self.backend)

    def after_backward(self, gaussians: Gaussians, step: Step) -> None:
        """Update the blur widths of the step's photograph."""
        if self.blur is not None:
            self.blur.learn(step)

    def findings(self) -> list[str]:
        """Return lines with the number of views for each k, and the trained blur widths."""
        settings = self.settings
        early, late = (
            ", ".join(f"{count} at {k}" for k, count in sorted(counts.items()))
            for counts in (
                Counter(_clamped(need, factor) for need in self.needs)
                for factor in (settings.factor, settings.late_factor)
            )
        )
        later = "" if late == early else f"; from step {settings.late_from} on {late}"
        line = f"supersampled: views at k times their size: {early}{later}"
        return [line, *(self.blur.findings() if self.blur is not None else ())]

    def state_dict(self) -> dict[str, Any]:
        """Return the state of the blur; empty without one."""
        return {} if self.blur is None else self.blur.state_dict()

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore a state of `state_dict`."""
        if self.blur is not None:
            self.blur.load_state_dict(state)

    def _factor(self, step: Step) -> int:
        """Return k of the step's view."""
        settings = self.settings
        late = step.nominal >= settings.late_from
        return _clamped(step.view.supersampling, settings.late_factor if late else settings.factor)

    def _blur_of(self, step: Step) -> BlurWidths | None:
        return self.blur if step.view.tag == "LR" else None

    def _resolved(self, camera: Camera, step: Step) -> Camera:
        """Return the camera at the resolution of the photograph, smaller than it after a zoom."""
        if self.zoom == 1 or step.view.tag == "HR":
            return camera
        return camera.resized(camera.width // self.zoom, camera.height // self.zoom)


def _clamped(need: float, factor: int) -> int:
    return min(max(1, round(need)), factor)


def _block_means(image: Tensor, side: int) -> Tensor:
    """Average the blocks of `side` x `side` pixels of an image [side * H, side * W, 3]."""
    # Not torch's pooling: the order in which it adds depends on the processor.
    total = image.new_zeros(())
    for y in range(side):
        for x in range(side):
            total = total + image[y::side, x::side]
    return total / side**2
