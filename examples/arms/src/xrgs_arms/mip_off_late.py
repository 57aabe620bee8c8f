"""Mip-Splatting's 3D smoothing filter [yu2024], left out of the last steps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Self

from xrgs.config import MipConf
from xrgs.errors import XrgsError
from xrgs.training.components import Step, TrainingSetup, TrainingView, check_not_negative
from xrgs.training.components.mip import Mip

if TYPE_CHECKING:
    from torch import Tensor

    from xrgs.splat.gaussians import ActivatedGaussians, Gaussians


@dataclass
class Settings:
    """The keys under `components.plugins.mip_off_late` of the config."""

    variance: float = 0.0
    """The variance of the filter, px^2 of the finest view that sees a Gaussian; 0 is off.
    Mip-Splatting's value is 0.2."""
    every: int = 100
    """Steps of this run between two updates of the sampling rates; Mip-Splatting's value."""
    until: int = 20_000
    """The step of a 30,000-step run from which on Gaussians are trained without the filter, which
    becomes part of them just before. Our choice."""


class MipOffLate(Mip):
    """The component `mip` of xrgs, only until a step.

    Just before step `until` the filter is applied to the trained scales and opacities for good, so
    that the render stays the same. If the filter were only dropped, every Gaussian would become
    smaller and more opaque at that step. Adam's moments stay as they are. All of it is our choice.
    """

    settings_type = Settings

    def __init__(self, settings: Settings, views: Sequence[TrainingView], near: float) -> None:
        """Take cameras and masks from the views, and the near plane's depth, world units."""
        super().__init__(MipConf(variance=settings.variance, every=settings.every), views, near)
        self.until = settings.until
        self.baked = False
        """Whether the filter is part of the Gaussians."""

    @classmethod
    def from_settings(  # type: ignore[override]  # settings of its own
        cls, settings: Settings, setup: TrainingSetup
    ) -> Self | None:
        """Build the component; a `variance` of 0 leaves it off.

        Raises:
            XrgsError: A setting is out of its range.
        """
        key = "components.plugins.mip_off_late"
        check_not_negative(f"{key}.variance", settings.variance)
        for name in ("every", "until"):
            if (value := getattr(settings, name)) < 1:
                raise XrgsError(f"{key}.{name}={value}: must be at least 1")
        if settings.variance == 0:
            return None
        return cls(settings, setup.data.train, setup.splat.raster.near)

    def opacity_attenuation(self, gaussians: Gaussians) -> Tensor | None:
        """Return the factors [N] of the filter on the opacities; None after step `until`."""
        return None if self.baked else super().opacity_attenuation(gaussians)

    def on_gaussians_changed(self, gaussians: Gaussians) -> None:
        """Compute the filter of the Gaussians as they are now."""
        if not self.baked:
            super().on_gaussians_changed(gaussians)

    def before_render(self, activated: ActivatedGaussians, step: Step) -> ActivatedGaussians:
        """Apply the filter to scales and opacities."""
        return activated if self.baked else super().before_render(activated, step)

    def after_step(self, gaussians: Gaussians, step: Step) -> None:
        """Make the filter part of the Gaussians before step `until`."""
        if not self.baked and replace(step, number=step.number + 1).nominal >= self.until:
            self.bake(gaussians)
            self.baked = True

    def bake(self, gaussians: Gaussians) -> None:
        """Apply the filter to the scales and opacities, unless they have it already."""
        if not self.baked:
            super().bake(gaussians)

    def state_dict(self) -> dict[str, Any]:
        """Return the filter, and whether it is part of the Gaussians."""
        return super().state_dict() | {"baked": self.baked}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore what `state_dict` returned."""
        super().load_state_dict(state)
        self.baked = bool(state["baked"])
