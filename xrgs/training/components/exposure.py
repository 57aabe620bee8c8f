"""A colour map of each photograph, learned with the splats: exposure and white balance."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Self

import torch
from torch import Tensor

from xrgs.errors import XrgsError
from xrgs.training.components.adam import RowAdam
from xrgs.training.components.base import (
    Component,
    Step,
    TrainingSetup,
    TrainingView,
    check_not_negative,
)

if TYPE_CHECKING:
    from xrgs.config import ExposureConf
    from xrgs.splat.gaussians import Gaussians


class Exposure(Component):
    """Gives each training photograph a colour map of its own, which splats need not explain then.

    Cameras choose exposure and white balance for each photograph. With c the colour of a pixel of
    the render, the loss of photograph i compares the photograph with

        M_i c + b_i,

    where M_i is a 3 x 3 matrix and b_i an offset, both in sRGB values of range 1, as photographs
    are. The map [M_i | b_i] begins as the identity and is learned by Adam [kingma2015] with a rate
    of its own, which falls exponentially from `lr` to `lr_final` times it. `mode` chooses what is
    learned: `affine` all twelve numbers, `gain` the diagonal of M_i alone.

    The authors' code of 3D Gaussian Splatting [kerbl2023] has such a 3 x 4 map for each photograph,
    with rates from 0.01 to 0.001, and the identity at its start is all that holds it. Urban
    Radiance Fields [rematas2022] have a 3 x 3 matrix. Ours:

    - The mean map of the HR training photographs is the identity: after every step its deviation is
      subtracted from all maps. Otherwise splats and maps could drift together, and test views,
      which have no map, would be of other colours than the photographs on the average. Without HR
      views the mean is over all training views.
    - `prior` times the squared distance of a map to the identity, the sum over its numbers, is
      added to the loss.
    - A map moves at steps on its own photograph alone.

    The map comes after all that forms the photograph in `to_photograph`. It applies to what the
    consistency loss compares too: the map of a pixel and the resampling of pixels commute. No map
    is applied at evaluation; `psnr_fitted` tells the score after the best map for each test view.

    `exposure.gain` records the gain of the step's map: the mean of the sums of M_i's rows, by which
    it multiplies the brightness of grey.
    """

    def __init__(self, settings: ExposureConf, views: Sequence[TrainingView]) -> None:
        """Start with the identity for every view.

        Args:
            settings: `components.exposure` of the config.
            views: All training views.
        """
        self.settings = settings
        self.names = [view.name for view in views]
        of_hr = [at for at, view in enumerate(views) if view.tag == "HR"]
        self.reference = of_hr or list(range(len(views)))
        """The views over which the mean map is the identity."""
        self.learned = torch.ones(3, 4) if settings.mode == "affine" else torch.eye(3, 4)
        """1 for a number that is learned, 0 for another [3, 4]."""
        self.deviations = RowAdam(torch.zeros(len(views), 3, 4))
        """Map less identity."""
        self.drawn: Tensor | None = None
        """The map of the step's view [3, 4], which gets the gradient."""

    @classmethod
    def from_settings(cls, settings: ExposureConf, setup: TrainingSetup) -> Self | None:
        """Build the component; the mode `none` leaves it off.

        Raises:
            XrgsError: The mode is unknown, or a number is out of its range.
        """
        key = "components.exposure"
        if settings.mode not in ("none", "affine", "gain"):
            raise XrgsError(f"{key}.mode={settings.mode}: must be none, affine or gain")
        if settings.mode == "none":
            return None
        for name in ("lr", "prior"):
            check_not_negative(f"{key}.{name}", getattr(settings, name))
        if not 0 < settings.lr_final <= 1:
            raise XrgsError(f"{key}.lr_final={settings.lr_final}: must be in (0, 1]")
        return cls(settings, setup.data.train)

    def map_of(self, name: str) -> Tensor:
        """Return the map [3, 4] of a photograph, float32."""
        colors: Tensor = torch.eye(3, 4) + self.deviations.values[self.names.index(name)]
        return colors.float()

    def match_colors(self, image: Tensor, step: Step) -> Tensor:
        """Return the render [H, W, 3] in the colours of its photograph."""
        colors = self.map_of(step.view.name).to(image)
        if torch.is_grad_enabled():  # other renders are looked at, and teach nothing
            self.drawn = colors.requires_grad_()
            step.log["exposure.gain"] = _gain(colors)
        return apply_map(image, colors)

    def after_backward(self, gaussians: Gaussians, step: Step) -> None:
        """Move the map of the step's photograph, and bring the mean map to the identity."""
        del gaussians
        if self.drawn is None or self.drawn.grad is None:
            return
        at, settings = self.names.index(step.view.name), self.settings
        maps = self.deviations.values
        gradient = self.drawn.grad.to(maps) + 2 * settings.prior * maps[at]
        rate = settings.lr * settings.lr_final ** (step.number / step.total)
        self.deviations.update(at, gradient * self.learned, rate)
        # Written out: the order in which torch adds depends on the processor.
        maps -= sum(maps[i] for i in self.reference) / len(self.reference)
        self.drawn = None

    def findings(self) -> list[str]:
        """Return the smallest and the largest gain with the names of the photographs."""
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
        """Restore what `state_dict` returned."""
        self.deviations.load_state_dict(state)


def apply_map(image: Tensor, colors: Tensor) -> Tensor:
    """Return M c + b for each colour c of an image.

    Args:
        image: [H, W, 3].
        colors: [M | b], [3, 4].

    Returns:
        [H, W, 3]; once differentiable in both.
    """
    mapped: Tensor = _ApplyMap.apply(image, colors)  # type: ignore[no-untyped-call]
    return mapped


class _ApplyMap(torch.autograd.Function):
    # Products are written out, and sums over pixels are in double: the order in which torch adds
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
    """The weighted sum [H, W] of the three channels."""
    first, second, third = (image[..., i] * weights[i] for i in range(3))
    return first + second + third


def _gain(colors: Tensor) -> float:
    return math.fsum(colors[:, :3].flatten().tolist()) / 3
