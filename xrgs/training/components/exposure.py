"""An affine colour map for each photograph, trained with the Gaussians: exposure, white balance."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Self

import torch
from torch import Tensor

from xrgs.training.components.adam import RowAdam
from xrgs.training.components.base import Component, Step, TrainingSetup, TrainingView

if TYPE_CHECKING:
    from xrgs.config import ExposureConf
    from xrgs.splat.gaussians import Gaussians


class Exposure(Component):
    """Trains an affine colour map for each training photograph, besides the Gaussians.

    Cameras choose exposure and white balance for each photograph. For a pixel of the render with
    colour c, the loss compares photograph i with

        M_i c + b_i,

    where M_i is a 3 x 3 matrix and b_i an offset, both for sRGB values in 0..1. The map
    [M_i | b_i] starts as the identity and is trained by Adam [kingma2015]; the rate falls
    exponentially from `lr` to `lr * lr_final`. `mode` chooses the trained numbers: `affine` all
    twelve, `gain` only the diagonal of M_i.

    The authors' code of 3D Gaussian Splatting [kerbl2023] has such a 3 x 4 map for each photograph,
    with rates from 0.01 to 0.001; it starts as the identity without any further constraint. Urban
    Radiance Fields [rematas2022] have a 3 x 3 matrix. Our additions:

    - The mean map of the HR training photographs is the identity: after every step the deviation of
      the mean is subtracted from all maps. Otherwise Gaussians and maps could drift together, and
      test views, which have no map, would have a colour cast. Without HR views the mean is over all
      training views.
    - `prior` times the squared distance of a map from the identity, summed over its numbers, is
      added to the loss.
    - A map is updated only at steps on its photograph.

    The map is applied after `to_photograph`, and also before the consistency loss: a map of each
    pixel and resampling commute. No map is applied at evaluation; `psnr_fitted` is the score after
    the best map for each test view.

    `exposure.gain` records the gain of the step's map, its factor for the brightness of grey: the
    mean of the row sums of M_i.
    """

    def __init__(self, settings: ExposureConf, views: Sequence[TrainingView]) -> None:
        """Start with the identity for every view."""
        self.settings = settings
        self.names = [view.name for view in views]
        of_hr = [at for at, view in enumerate(views) if view.tag == "HR"]
        self.reference = of_hr or list(range(len(views)))
        """Indices of the views whose mean map is the identity."""
        self.learned = torch.ones(3, 4) if settings.mode == "affine" else torch.eye(3, 4)
        """[3, 4] 1 for a trained number of the map, 0 for a fixed one."""
        self.deviations = RowAdam(torch.zeros(len(views), 3, 4))
        """Map minus identity, for each view [views, 3, 4]."""
        self.drawn: Tensor | None = None
        """Map of the step's view [3, 4], on which the gradient accumulates."""

    @classmethod
    def from_settings(cls, settings: ExposureConf, setup: TrainingSetup) -> Self:
        """Build the component."""
        return cls(settings, setup.data.train)

    def map_of(self, name: str) -> Tensor:
        """Return the map [3, 4] of a photograph, float32."""
        colors: Tensor = torch.eye(3, 4) + self.deviations.values[self.names.index(name)]
        return colors.float()

    def match_colors(self, image: Tensor, step: Step) -> Tensor:
        """Return the render [H, W, 3] in the colours of its photograph."""
        colors = self.map_of(step.view.name).to(image)
        if torch.is_grad_enabled():  # not for other components' renders
            self.drawn = colors.requires_grad_()
            step.log["exposure.gain"] = _gain(colors)
        return apply_map(image, colors)

    def after_backward(self, gaussians: Gaussians, step: Step) -> None:
        """Update the map of the step's photograph, and reset the mean map to the identity."""
        if self.drawn is None or self.drawn.grad is None:
            return
        at, settings = self.names.index(step.view.name), self.settings
        maps = self.deviations.values
        gradient = self.drawn.grad.to(maps) + 2 * settings.prior * maps[at]
        rate = settings.lr * settings.lr_final ** (step.number / step.total)
        self.deviations.update(at, gradient * self.learned, rate)
        # Not `mean`: the order in which torch adds depends on the processor.
        maps -= sum(maps[i] for i in self.reference) / len(self.reference)
        self.drawn = None

    def findings(self) -> list[str]:
        """Return a line with the smallest and the largest gain and their photographs."""
        gains = {name: _gain(self.map_of(name)) for name in self.names}
        low, high = min(gains, key=lambda n: gains[n]), max(gains, key=lambda n: gains[n])
        return [
            f"exposure: the gains of the photographs are {gains[low]:.3f} ({low}) to"
            f" {gains[high]:.3f} ({high})"
        ]

    def state_dict(self) -> dict[str, Any]:
        """Return the maps and the state of their optimizer."""
        return self.deviations.state_dict()

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore a state of `state_dict`."""
        self.deviations.load_state_dict(state)


def apply_map(image: Tensor, colors: Tensor) -> Tensor:
    """Return M c + b for each colour c of an image [H, W, 3]; `colors` is [M | b], [3, 4].

    The result is once differentiable in both.
    """
    mapped: Tensor = _ApplyMap.apply(image, colors)  # type: ignore[no-untyped-call]
    return mapped


class _ApplyMap(torch.autograd.Function):
    # Without matrix products, and with sums over pixels in double: the order in which torch adds
    # depends on the processor and on the number of threads.
    @staticmethod
    def forward(ctx: Any, image: Tensor, colors: Tensor) -> Tensor:
        ctx.save_for_backward(image, colors)
        return torch.stack([_weighted(image, row[:3]) + row[3] for row in colors], dim=-1)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, v_mapped: Tensor) -> tuple[Tensor, Tensor]:
        image, colors = ctx.saved_tensors
        v_image = torch.stack([_weighted(v_mapped, colors[:, i]) for i in range(3)], dim=-1)
        v_flat, flat = (x.reshape(-1, 3).double() for x in (v_mapped, image))
        v_colors = torch.cat([v_flat.T @ flat, v_flat.sum(dim=0)[:, None]], dim=1)
        return v_image, v_colors.to(colors.dtype)


def _weighted(image: Tensor, weights: Tensor) -> Tensor:
    """Return the weighted sum [H, W] of the three channels."""
    first, second, third = (image[..., i] * weights[i] for i in range(3))
    return first + second + third


def _gain(colors: Tensor) -> float:
    return math.fsum(colors[:, :3].flatten().tolist()) / 3
