"""The settings of the splatting model: gsplat 1.5.3's defaults (`examples/simple_trainer.py`).

Plain dataclasses without torch, so that a plan can be made without importing it. Step counts are
those of a 30,000-step run; `scaled` shrinks them with the run, as gsplat's `adjust_steps` does.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

NOMINAL_STEPS = 30_000


@dataclass
class RasterSettings:
    """How Gaussians become pixels."""

    sh_degree: int = 3
    """Highest band of the spherical harmonics, 0 to 3."""
    near: float = 0.01
    """Gaussians closer than this (world units along z) are dropped."""
    eps2d: float = 0.3
    """Variance added to every projected Gaussian, px^2."""
    alpha_min: float = 1.0 / 255.0
    """Contributions below this are skipped."""
    alpha_max: float = 0.99
    """Cap of a contribution; its gradient is zero where clipped (gsplat 1.6; 0.999 in 1.5.3)."""
    transmittance_min: float = 1e-4
    """A pixel is finished once the next Gaussian would leave less light than this."""
    antialiased: bool = False
    """Compensate the opacity for `eps2d`, as Mip-Splatting's 2D filter does."""
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Colour behind the last Gaussian."""
    absgrad: bool = False
    """The gradient of `means2d_offset` is, per axis, the sum of its absolute values over pixels, so
    that pixels which pull a Gaussian apart do not cancel (AbsGS; gsplat's `absgrad`)."""


@dataclass(frozen=True)
class CullingOptions:
    """Work that the compiled renderer leaves out, each kind as long as it is true.

    The image is the same with any of them off, to rounding at the cuts; they are here to be
    measured.
    """

    out_of_view: bool = True
    """Gaussians whose box of reach does not overlap the image."""
    sub_threshold: bool = True
    """Gaussians whose opacity is below `alpha_min`."""
    tiles: bool = True
    """16x16 px tiles that a Gaussian's box of reach overlaps, but not its ellipse."""
    blocks: bool = True
    """4x4 px blocks of a tile that a Gaussian does not reach."""
    saturated: bool = True
    """What lies behind the last Gaussian that any pixel of a block composites."""


@dataclass
class OptimizerSettings:
    """Adam's learning rates, one a parameter group."""

    means: float = 1.6e-4
    """Times the scene's scale; decays exponentially to `means_final` of itself."""
    means_final: float = 0.01
    scales: float = 5e-3
    opacities: float = 5e-2
    quats: float = 1e-3
    sh0: float = 2.5e-3
    shN: float = 2.5e-3 / 20  # noqa: N815
    beta1: float = 0.9
    beta2: float = 0.999
    eps: float = 1e-15


@dataclass
class DensifySettings:
    """gsplat's `DefaultStrategy`: when Gaussians are grown, pruned and reset."""

    start: int = 500
    stop: int = 15_000
    every: int = 100
    reset_every: int = 3_000
    grow_grad2d: float = 2e-4
    """Mean norm of the image-plane gradient (normalised device units) above which one grows."""
    grow_scale3d: float = 0.01
    """Times the scene's scale: smaller Gaussians are duplicated, larger ones split."""
    prune_opacity: float = 0.005
    prune_scale3d: float = 0.1
    """Times the scene's scale: larger Gaussians are pruned after the first reset."""
    reset_opacity: float = 2.0
    """Times `prune_opacity`: the value that a reset caps opacities at."""

    def scaled(self, steps: int) -> DensifySettings:
        """The same schedule for a run of `steps` steps."""
        factor = steps / NOMINAL_STEPS
        return replace(
            self,
            start=int(self.start * factor),
            stop=int(self.stop * factor),
            every=max(1, int(self.every * factor)),
            reset_every=max(1, int(self.reset_every * factor)),
        )
