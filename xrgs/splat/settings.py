"""The settings of the splatting model, with gsplat 1.5.3's defaults.

The defaults are from `examples/simple_trainer.py` and `strategy/default.py`. This module does not
import torch, so that planning is quick. Step counts are for a run of 30,000 steps;
`DensifySettings.scaled` adapts them to shorter runs, as the trainer's `adjust_steps` does.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field, fields, replace
from operator import ge, gt, le, lt
from typing import Any

NOMINAL_STEPS = 30_000
"""Length of the run, in steps, that all step counts in settings refer to."""

SSIM_WINDOW = 11
"""Side of the SSIM window in the training loss, px. Training images must be at least as large."""

KEPT_BYTES = 264 * 2**20
"""Largest memory for the cached SSIM statistics of photographs (`Target`), bytes: enough for 63
photographs of 504 x 378 px or 15 of 1,008 x 756 px. Others are computed anew at every step."""

STRATEGIES = ("default", "mcmc")
"""Names of the densification strategies, as in gsplat (`xrgs.training.loop`)."""

STARTS = ("sfm", "dense")
"""Where the first Gaussians are placed: on the SfM points, or also on surfaces from stereo
matching (`xrgs.training.dense`)."""

DECIDE = ("current_view", "per_class", "own_threshold")
"""Which thresholds apply at a refinement, where views have groups (`Groups` of
`xrgs.splat.strategy.base`)."""

SPLITS = ("random", "long_axis")
"""The values of `DensifySettings.split`."""


def off_by_default(value: Any, **limits: Any) -> Any:
    """Declare a setting whose default means "off". At its default it is in no cell's id."""
    return field(default=value, metadata={"off": value, **limits})


def outside_limits(group: Any, path: str = "") -> Iterator[str]:
    """Yield a message for each setting of a dataclass outside its limits; it begins with its key.

    The limits are in the metadata of its field: `choices`, or `finite` of True, and the bounds
    `least`, `above`, `most` and `below`. `path` is that of the group, with a dot at its end.
    """
    for key in fields(group):
        value, limits = getattr(group, key.name), key.metadata
        if value not in limits.get("choices", [value]):
            yield f"{path}{key.name}={value}: must be one of {', '.join(limits['choices'])}"
        bounds = [(words, limits[name], holds) for name, words, holds in _BOUNDS if name in limits]
        finite = not limits.get("finite") or math.isfinite(value)
        if not (finite and all(holds(value, bound) for _, bound, holds in bounds)):
            rules = ["finite"] if limits.get("finite") else []
            rules += [f"{words} {bound}" for words, bound, _ in bounds]
            yield f"{path}{key.name}={value}: must be {' and '.join(rules)}"


_BOUNDS = (
    ("least", "at least", ge),
    ("above", "above", gt),
    ("most", "at most", le),
    ("below", "below", lt),
)


@dataclass
class RasterSettings:
    """How Gaussians become pixels (arguments of gsplat's `rasterization`).

    Examples:
        >>> RasterSettings(antialiased=True).eps2d
        0.3
    """

    sh_degree: int = field(default=3, metadata={"least": 0, "most": 3})
    """Highest band of the spherical harmonics, 0 to 3."""
    near: float = 0.01
    """Gaussians at this depth or nearer are not rendered, world units along z."""
    eps2d: float = 0.3
    """Variance added to every projected Gaussian, px^2."""
    alpha_min: float = 1.0 / 255.0
    """Contributions to a pixel whose alpha is below this are skipped."""
    alpha_max: float = 0.99
    """Cap of a contribution's alpha, with a zero gradient where it caps: gsplat 1.6's value (1.5.3
    has 0.999)."""
    transmittance_min: float = 1e-4
    """Compositing of a pixel ends before the Gaussian that would reduce its transmittance to this
    or less."""
    antialiased: bool = off_by_default(False)
    """Compensate the opacity for `eps2d`, as the 2D Mip filter of Mip-Splatting [yu2024] does."""
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Colour behind the last Gaussian."""
    absgrad: bool = off_by_default(False)
    """Sum absolute values of the pixels' gradients, for each axis, into the gradient of
    `means2d_offset`, so that opposite gradients do not cancel (AbsGS [ye2024absgs]; gsplat's
    `absgrad`)."""


@dataclass(frozen=True)
class CullingOptions:
    """Which work the native rasterizer skips because it can't change the image.

    Only benchmarks switch options off. A Gaussian's ellipse is where its alpha is at least
    `alpha_min`. Apart from rounding at the cut-offs, the image does not depend on these options.
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
    """Skip Gaussians behind the last one that a pixel of the block composites."""


#: Limits of a learning rate, where 0 keeps a parameter, and of a decay of Adam's moments.
_RATE, _DECAY = {"least": 0}, {"least": 0, "below": 1}


@dataclass
class OptimizerSettings:
    """Adam's learning rate for each parameter, and its constants."""

    means: float = field(default=1.6e-4, metadata=_RATE)
    """Rate of means at the first step, times the scene's scale; it decays exponentially."""
    means_final: float = field(default=0.01, metadata=_RATE)
    """Rate of means after the last step, as a fraction of the first rate."""
    means_decay_from: int = field(default=0, metadata={"least": 0, "below": NOMINAL_STEPS})
    """Step of a 30,000-step run at which the rate of means begins to decay; 0 is gsplat's."""
    scales: float = field(default=5e-3, metadata=_RATE)
    """Rate of log scales."""
    opacities: float = field(default=5e-2, metadata=_RATE)
    """Rate of logit opacities."""
    quats: float = field(default=1e-3, metadata=_RATE)
    sh0: float = field(default=2.5e-3, metadata=_RATE)
    shN: float = field(default=2.5e-3 / 20, metadata=_RATE)  # noqa: N815
    shN_every: int = field(default=1, metadata={"least": 1})  # noqa: N815
    """Steps between two updates of shN, whose rate is multiplied by this; 1 in gsplat."""
    length_power: float = off_by_default(0.0, least=0, most=1)
    """Power p, 0 to 1: in runs below 30,000 steps, the rates of scales, quats, sh0 and shN are
    multiplied by (30,000 / steps)^p (`SplatOptimizer`). 0 keeps gsplat's rates."""
    length_decay_from: int = off_by_default(18_000, least=0, below=NOMINAL_STEPS)
    """Step of a 30,000-step run at which these rates begin to fall to gsplat's. Our choice."""
    beta1: float = field(default=0.9, metadata=_DECAY)
    """Decay of the first moment, per step."""
    beta2: float = field(default=0.999, metadata=_DECAY)
    """Decay of the second moment, per step."""
    eps: float = field(default=1e-15, metadata={"above": 0})
    """Added to the root of the second moment."""


@dataclass
class DensifySettings:
    """When Gaussians are grown, pruned and reset (gsplat's `DefaultStrategy` and `MCMCStrategy`).

    `MCMCStrategy` reads only `start`, `stop`, `every`, `prune_opacity`, `budget` and `noise`.

    Gaussians are refined at steps above `start` and below `stop` that are a multiple of `every`.
    Opacities are reset at steps above 0 and below `stop` that are a multiple of `reset_every`, if
    `resets` is true.
    """

    start: int = 500
    stop: int = 15_000
    every: int = field(default=100, metadata={"least": 1})
    reset_every: int = field(default=3_000, metadata={"least": 1})
    resets: bool = off_by_default(True)
    """Whether opacities are reset; gsplat 1.5.3 never resets (`xrgs.splat.strategy.default`)."""
    grow_grad2d: float = 2e-4
    """A Gaussian grows if the mean norm of its image-plane gradient, in normalised device units, is
    above this."""
    grow_scale3d: float = 0.01
    """A growing Gaussian is split if its largest scale is above this times the scene's scale, else
    duplicated."""
    prune_opacity: float = 0.005
    """A Gaussian is pruned if its opacity is below this."""
    prune_scale3d: float = 0.1
    """At refinements after step `reset_every`, a Gaussian is pruned if its largest scale is above
    this times the scene's scale."""
    reset_opacity: float = 2.0
    """A reset caps opacities at this times `prune_opacity`."""
    split: str = field(default="random", metadata={"choices": SPLITS})
    """How Gaussians grow. `random`: as in gsplat, small Gaussians are duplicated and large ones
    are split into two, with means drawn from the Gaussian. `long_axis`: all are split into two side
    by side along the longest axis (`xrgs.splat.strategy.ops.split_along_longest_axis`)."""
    budget: float = off_by_default(0.0, finite=True, least=0)
    """Growth stops at this number of Gaussians, per pixel of the largest training view
    (`xrgs.splat.strategy.ops.Budget`); 0 sets no limit. The unit is our choice."""
    noise: float = off_by_default(0.0, finite=True, least=0)
    """Size of the noise that `MCMCStrategy` adds to the means at every step, as a multiple of the
    learning rate of means. gsplat's is 5e5."""

    @property
    def last_refinement(self) -> int:
        """The last step at which Gaussians are refined (none are if it is not above `start`)."""
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
