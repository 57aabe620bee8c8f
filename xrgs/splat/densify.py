"""Where Gaussians come from and go to: gsplat's `DefaultStrategy`, on the same inputs the same.

One thing is as gsplat means it and not as its release 1.5.3 does it: there the opacity reset never
happens, since `step % reset_every == 0 & step > 0` compares with `0 & step` (its pull request 776
mends it).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from xrgs.splat.gaussians import PARAMETERS
from xrgs.splat.optimizer import SplatOptimizer
from xrgs.splat.projection import rotations
from xrgs.splat.settings import DensifySettings

SPLIT_SHRINK = 1.6
"""How many times smaller than the Gaussian it replaces each of a split's two is."""


@dataclass(frozen=True)
class Refinement:
    """What a step's densification did; all 0 at most steps.

    Each Gaussian removed is counted once, by the first rule that holds in the order below, so that
    the number of Gaussians grows by exactly `duplicated + split - removed`.
    """

    duplicated: int = 0
    """Small ones with a high gradient: a copy was added."""
    split: int = 0
    """Large ones with a high gradient: replaced by two."""
    pruned_non_finite: int = 0
    """A parameter, or the exponential of a scale, was infinite or no number."""
    pruned_opacity: int = 0
    """Almost transparent."""
    pruned_scale: int = 0
    """Too large, and opaque enough to have stayed."""
    reset: int = 0
    """Opacities lowered to the cap."""

    @property
    def removed(self) -> int:
        """Gaussians gone, those that a split replaced aside."""
        return self.pruned_non_finite + self.pruned_opacity + self.pruned_scale


class Densifier:
    """Grows, prunes and resets Gaussians by the statistics of the steps since it last did.

    At steps above `start` and below `stop` that `every` divides: those whose image-plane gradient,
    averaged over the views that saw them, is above `grow_grad2d` are duplicated (largest scale at
    most `grow_scale3d * scene_scale`) or split in two; then those with an opacity below
    `prune_opacity` are removed, and after step `reset_every` those with a scale above
    `prune_scale3d * scene_scale`. At steps above 0 that `reset_every` divides, opacities are capped
    at `reset_opacity * prune_opacity`. With none left, all of it is a no-op.

    Attributes:
        gradient: [N] sum of the norms of the image-plane gradients, in normalised device units.
        seen: [N] views that they are the sum of.
    """

    def __init__(
        self,
        optimizer: SplatOptimizer,
        settings: DensifySettings,
        *,
        scene_scale: float,
        generator: torch.Generator,
    ) -> None:
        """Start with empty statistics.

        Args:
            optimizer: Of the Gaussians to densify.
            settings: Already scaled to the run's length.
            scene_scale: World units.
            generator: Draws where the halves of a split go.
        """
        self.optimizer = optimizer
        self.gaussians = optimizer.gaussians
        self.settings = settings
        self.scene_scale = scene_scale
        self.generator = generator
        self._forget()

    def after_step(
        self, step: int, means2d_grad: Tensor | None, visible: Tensor, *, width: int, height: int
    ) -> Refinement:
        """Note a step's statistics and, when it is time, refine and reset.

        Args:
            step: From 0, after the optimizer's step.
            means2d_grad: [N, 2] gradient of the loss by the projected means, per px; None where
                the render depends on no Gaussian, and then nothing is noted.
            visible: [N] bool, seen by this step's view.
            width: Of the view, px.
            height: Of the view, px.

        Returns:
            What was done.
        """
        settings = self.settings
        if step >= settings.stop:
            return Refinement()
        if means2d_grad is not None:
            self._observe(means2d_grad, visible, width, height)
        counts: dict[str, int] = {}
        if step > settings.start and step % settings.every == 0:
            counts |= self._drop_non_finite()
            counts |= self._grow()
            counts |= self._prune(too_large=step > settings.reset_every)
            self._forget()
        if step > 0 and step % settings.reset_every == 0:
            counts |= self._reset_opacities()
        return Refinement(**counts)

    @torch.no_grad()
    def _observe(self, means2d_grad: Tensor, visible: Tensor, width: int, height: int) -> None:
        # gsplat's units: an image is 2 wide and 2 high, whatever its size in pixels.
        units = width / 2, height / 2
        if self.optimizer.native:
            from xrgs.splat import native_densify

            native_densify.observe(means2d_grad, visible, units, self.gradient, self.seen)
            return
        scaled = means2d_grad * means2d_grad.new_tensor(units)
        self.gradient += torch.where(visible, scaled.norm(dim=-1), 0)
        self.seen += visible

    def _forget(self) -> None:
        self.gradient = self.gaussians.opacities.new_zeros(len(self.gaussians))
        self.seen = torch.zeros_like(self.gradient)

    @torch.no_grad()
    def _drop_non_finite(self) -> dict[str, int]:
        """Before growing, so that they leave no copies."""
        finite = torch.isfinite(self._largest_scale())
        for name in PARAMETERS:
            finite &= torch.isfinite(self.gaussians[name][..., None]).flatten(1).all(dim=1)
        self._keep(finite)
        self.gradient, self.seen = self.gradient[finite], self.seen[finite]
        return {"pruned_non_finite": int((~finite).sum())}

    @torch.no_grad()
    def _grow(self) -> dict[str, int]:
        high = self.gradient / self.seen.clamp_min(1) > self.settings.grow_grad2d
        small = self._largest_scale() <= self.settings.grow_scale3d * self.scene_scale
        duplicate, split = high & small, high & ~small
        copies = {name: self.gaussians[name][duplicate] for name in PARAMETERS}
        halves = self._halves(split)
        self._keep(~split)
        self.optimizer.append(
            {name: torch.cat([copies[name], halves[name]]) for name in PARAMETERS}
        )
        return {"duplicated": int(duplicate.sum()), "split": int(split.sum())}

    def _halves(self, mask: Tensor) -> dict[str, Tensor]:
        """Two Gaussians for each in `mask` [N]: smaller, their means drawn from the old one."""
        old = {name: self.gaussians[name][mask] for name in PARAMETERS}  # [M, ...]
        scales = old["scales"].exp()
        noise = torch.randn(2, len(scales), 3, generator=self.generator, dtype=scales.dtype)
        rotation = rotations(old["quats"])  # [M, 3, 3]
        offsets = torch.einsum("nij,nj,bnj->bni", rotation, scales, noise)  # [2, M, 3]
        halves = {name: torch.cat([value, value]) for name, value in old.items()}
        halves["means"] = (old["means"] + offsets).reshape(-1, 3)
        halves["scales"] = (scales / SPLIT_SHRINK).log().repeat(2, 1)
        return halves

    @torch.no_grad()
    def _prune(self, *, too_large: bool) -> dict[str, int]:
        opaque = torch.sigmoid(self.gaussians.opacities) >= self.settings.prune_opacity
        limit = self.settings.prune_scale3d * self.scene_scale if too_large else math.inf
        small = self._largest_scale() <= limit
        self._keep(opaque & small)
        return {
            "pruned_opacity": int((~opaque).sum()),
            "pruned_scale": int((opaque & ~small).sum()),
        }

    @torch.no_grad()
    def _reset_opacities(self) -> dict[str, int]:
        value = torch.tensor(self.settings.reset_opacity * self.settings.prune_opacity)
        cap = torch.logit(value).item()
        opacities = self.gaussians.opacities
        self.optimizer.reset("opacities", opacities.clamp(max=cap))
        return {"reset": int((opacities > cap).sum())}

    def _largest_scale(self) -> Tensor:
        """[N], world units."""
        return self.gaussians.scales.exp().amax(dim=-1)

    def _keep(self, mask: Tensor) -> None:
        """Remove all Gaussians but these [N]; most often none, and then nothing is copied."""
        if not mask.all():
            self.optimizer.keep(mask)
