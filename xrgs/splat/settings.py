"""The settings of the splatting model, with gsplat 1.5.3's defaults.

The defaults are from `examples/simple_trainer.py` and `strategy/default.py`. This module does not
import torch, so that planning is quick. Step counts are for a run of 30,000 steps;
`DensifySettings.scaled` shrinks them with the run, as the trainer's `adjust_steps` does.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

NOMINAL_STEPS = 30_000
"""Length of the run that step counts in settings are written for."""

SSIM_WINDOW = 11
"""The side of the window of SSIM in the training loss, px; an image must not be smaller."""

KEPT_BYTES = 264 * 2**20
"""The most bytes of moments that training keeps of its photographs (`Target`): of 63 photographs of
504 x 378 px, or of 15 of 1,008 x 756 px. Those of others are computed at every step on them."""

STRATEGIES = ("default", "mcmc")
"""The strategies of densification, by the names of gsplat's (`xrgs.training.loop`)."""

STARTS = ("sfm", "dense")
"""What training starts from: the SfM points, or also surfaces (`xrgs.training.dense`)."""

SPLITS = ("random", "long_axis")
"""The values of `DensifySettings.split`."""


def off_by_default(value: Any) -> Any:
    """Declare a setting with a default that changes nothing; identities leave it out there."""
    return field(default=value, metadata={"off": value})


@dataclass
class RasterSettings:
    """How Gaussians become pixels (arguments of gsplat's `rasterization`).

    Examples:
        >>> RasterSettings(antialiased=True).eps2d
        0.3
    """

    sh_degree: int = 3
    """Highest band of the spherical harmonics, 0 to 3."""
    near: float = 0.01
    """Gaussians whose depth (world units along z) is this or less are not rendered."""
    eps2d: float = 0.3
    """Variance added to every projected Gaussian, px^2."""
    alpha_min: float = 1.0 / 255.0
    """Contributions to a pixel whose alpha is below this are skipped."""
    alpha_max: float = 0.99
    """Cap of a contribution's alpha; the gradient is zero where it is capped (gsplat 1.6; 0.999 in
    1.5.3)."""
    transmittance_min: float = 1e-4
    """A pixel ends before the Gaussian that would leave it this transmittance or less."""
    antialiased: bool = off_by_default(False)
    """Compensate the opacity for `eps2d`, as the 2D Mip filter of Mip-Splatting [yu2024] does."""
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Colour behind the last Gaussian."""
    absgrad: bool = off_by_default(False)
    """Make the gradient of `means2d_offset` the sum, for each axis, of the absolute values of the
    pixels' gradients, so that pixels which pull a Gaussian apart do not cancel (AbsGS
    [ye2024absgs]; gsplat's `absgrad`)."""


@dataclass(frozen=True)
class CullingOptions:
    """Which work without effect the native rasterizer skips; off in measurements alone.

    A Gaussian's ellipse is where its alpha is at least `alpha_min`. The image does not depend on
    these options, to rounding at the cut-offs.
    """

    out_of_view: bool = True
    """Skip Gaussians if the bounding box of the ellipse does not overlap the image."""
    sub_threshold: bool = True
    """Skip Gaussians with an opacity below `alpha_min`."""
    tiles: bool = True
    """Skip 16x16 px tiles that the bounding box overlaps, but the ellipse does not."""
    blocks: bool = True
    """Skip 4x4 px blocks of a tile that the ellipse does not overlap."""
    saturated: bool = True
    """Skip Gaussians behind the last one that any pixel of a block composites."""


@dataclass
class OptimizerSettings:
    """Adam's learning rates, one for each parameter, and its constants."""

    means: float = 1.6e-4
    """Multiplied by the scene's scale; decays exponentially from the first step to the last."""
    means_final: float = 0.01
    """The rate of means after the last step, as a share of the first."""
    means_decay_from: int = 0
    """Step of a 30,000-step run at which the rate of means begins to decay; 0 is gsplat's."""
    scales: float = 5e-3
    """Rate of log scales."""
    opacities: float = 5e-2
    """Rate of logit opacities."""
    quats: float = 1e-3
    sh0: float = 2.5e-3
    shN: float = 2.5e-3 / 20  # noqa: N815
    shN_every: int = 1  # noqa: N815
    """Steps of this run between two steps of shN, whose rate is multiplied by it; 1 is gsplat's."""
    length_power: float = off_by_default(0.0)
    """The rates of scales, quats, sh0 and shN are multiplied by (30,000 / steps) to this power
    (`SplatOptimizer`); 0 to 1. 0 keeps gsplat's, and so does a run of 30,000 steps and more."""
    length_decay_from: int = off_by_default(18_000)
    """Step of a 30,000-step run at which these rates begin to fall to gsplat's. Our choice."""
    beta1: float = 0.9
    """Decay of the first moment, per step."""
    beta2: float = 0.999
    """Decay of the second moment, per step."""
    eps: float = 1e-15
    """Added to the root of the second moment."""


@dataclass
class DensifySettings:
    """When Gaussians are grown, pruned and reset (gsplat's `DefaultStrategy` and `MCMCStrategy`).

    `MCMCStrategy` reads `start`, `stop`, `every`, `prune_opacity`, `budget` and `noise` alone.

    A step that is a multiple of `every`, above `start` and below `stop` refines; one that is a
    multiple of `reset_every`, above 0 and below `stop`, resets opacities if `resets` is true.
    """

    start: int = 500
    stop: int = 15_000
    every: int = 100
    reset_every: int = 3_000
    resets: bool = off_by_default(True)
    """Whether opacities are reset; gsplat 1.5.3 never does (`xrgs.splat.strategy.default`)."""
    grow_grad2d: float = 2e-4
    """A Gaussian grows if the mean norm of its image-plane gradient (normalised device units) is
    above this."""
    grow_scale3d: float = 0.01
    """Multiplied by the scene's scale: a growing Gaussian whose largest scale is above this is
    split, otherwise duplicated."""
    prune_opacity: float = 0.005
    """A Gaussian is pruned if its opacity is below this."""
    prune_scale3d: float = 0.1
    """Multiplied by the scene's scale: a Gaussian whose largest scale is above this is pruned, at
    refinements after step `reset_every`."""
    reset_opacity: float = 2.0
    """Multiplied by `prune_opacity`: a reset caps opacities at this."""
    split: str = "random"
    """How Gaussians grow. `random`: as in gsplat, small Gaussians are duplicated, and large ones
    split into two with means drawn from the Gaussian. `long_axis`: all are split into two side by
    side along the longest axis (`xrgs.splat.strategy.ops.split_along_longest_axis`)."""
    budget: float = off_by_default(0.0)
    """The largest number of Gaussians to which growth may lead, for each pixel of the largest
    training view (`xrgs.splat.strategy.ops.Budget`); 0 sets no limit. The unit is our choice."""
    noise: float = off_by_default(0.0)
    """Multiplied by the learning rate of means: the size of the noise on the means that
    `MCMCStrategy` adds at every step. gsplat's is 5e5."""

    @property
    def last_refinement(self) -> int:
        """The last step at which Gaussians are refined, if `start` is below it."""
        return (self.stop - 1) // self.every * self.every

    def scaled(self, steps: int) -> DensifySettings:
        """Return the schedule for a run of `steps` steps.

        Step counts shrink in proportion and are rounded down; periods are at least 1.
        """
        factor = steps / NOMINAL_STEPS
        return replace(
            self,
            start=int(self.start * factor),
            stop=int(self.stop * factor),
            every=max(1, int(self.every * factor)),
            reset_every=max(1, int(self.reset_every * factor)),
        )
