"""Adaptive density control: growing, pruning and resetting Gaussians.

3D Gaussian Splatting [kerbl2023, section 5.2], as `DefaultStrategy` of gsplat [ye2025]
(`strategy/default.py` and `strategy/ops.py` of release 1.5.3) computes it: given the same inputs,
the results are the same.

One thing is as gsplat intends it and not as its release 1.5.3 does it. There the opacity reset
never happens, since `step % reset_every == 0 & step > 0` compares with `0 & step` (its pull request
776 mends it). And the random numbers of a split are drawn in double: those that torch draws in
float32 depend on the processor.

On the native backend, nothing here depends on the number of threads or on the processor.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from types import ModuleType
from typing import Any

import torch
from torch import Tensor

from xrgs.splat.backend import implementation
from xrgs.splat.gaussians import PARAMETERS
from xrgs.splat.growth import (
    Budget,
    best,
    gaussians_of,
    split_along_longest_axis,
    split_at_random,
)
from xrgs.splat.optimizer import SplatOptimizer
from xrgs.splat.refinement import DensifierHooks, Groups, Refinement, Thresholds
from xrgs.splat.settings import DensifySettings

_OPAQUE = 1 - 2**-24
"""The largest opacity whose logit is finite in float32."""

_COUNTED_BY_GROUP = ("grown", "pruned_opacity")
_NO_HOOKS = DensifierHooks()


class Densifier:
    """Grows, prunes and resets Gaussians by the image-plane gradients since the last refinement.

    Gaussians are refined at steps above `start` and below `stop` that `every` divides. Those whose
    image-plane gradient, averaged over the views in which they were visible, is above `grow_grad2d`
    are duplicated (where the largest scale is at most `grow_scale3d * scene_scale`) or split in
    two. Then those with an opacity below `prune_opacity` are removed and, after step
    `reset_every`, those with a scale above `prune_scale3d * scene_scale`. At steps above 0 and
    below `stop` that `reset_every` divides, opacities are capped at `reset_opacity *
    prune_opacity`. Without Gaussians, all of it does nothing.

    With `split=long_axis` all Gaussians that grow are split, along their longest axis. Within a
    budget (`xrgs.splat.growth.Budget`) the best of them grow, up to the refinement's cap. Pruning,
    which follows, makes room for the next refinement; nothing is removed for the budget itself.

    `groups` may replace `grow_grad2d` and `prune_opacity` by thresholds for each group of views.
    The cap is then that of the largest opacity threshold, since the next refinement would prune
    every opacity that is capped below its threshold. Where renders attenuate opacities, the
    attenuated ones are capped, as by Mip-Splatting [yu2024]: capping the others would leave
    Gaussians that are too faint to be rendered, and to be pruned.

    Attributes:
        grad2d_sum: [G, N] sum of the norms of the image-plane gradients, in normalised device
            units; G statistics, 1 unless each group has its own.
        visible_count: [G, N] number of views that were summed.
    """

    def __init__(
        self,
        optimizer: SplatOptimizer,
        settings: DensifySettings,
        *,
        scene_scale: float,
        generator: torch.Generator,
        groups: Groups | None = None,
        view_pixels: int = 0,
    ) -> None:
        """Start with empty statistics.

        Args:
            optimizer: The optimizer of the Gaussians, through which they are added and removed.
            settings: The schedule, already scaled to the run's length, and the thresholds.
            scene_scale: Extent of the scene, world units.
            generator: Random generator that draws the means of the two halves of a split.
            groups: Groups of views; None has one, with the thresholds of `settings`.
            view_pixels: Number of pixels of the training view that has the most of them, which
                `settings.budget` is multiplied by; not read where it is 0.
        """
        self.optimizer = optimizer
        self.gaussians = optimizer.gaussians
        self.settings = settings
        self.scene_scale = scene_scale
        self.generator = generator
        self.budget = (
            Budget(len(self.gaussians), gaussians_of(settings.budget, view_pixels))
            if settings.budget
            else None
        )
        self.shared_thresholds = Thresholds(settings.grow_grad2d, settings.prune_opacity)
        self.group_thresholds = {} if groups is None else dict(groups.thresholds)
        self.decide = "current_view" if groups is None else groups.decide
        self.per_group = self.decide != "current_view"
        #: Which of the G statistics the views of each group add to.
        self.group_rows = {
            name: row if self.per_group else 0 for row, name in enumerate(self.group_thresholds)
        }
        self.grad2d_sum: Tensor
        self.visible_count: Tensor
        self._clear_statistics()

    def after_step(
        self,
        step: int,
        means2d_grad: Tensor | None,
        visible: Tensor,
        *,
        width: int,
        height: int,
        group: str = "",
        hooks: DensifierHooks = _NO_HOOKS,
    ) -> Refinement:
        """Accumulate a step's statistics and, where the schedule says so, refine and reset.

        Args:
            step: Number of the step, from 0; the optimizer's step has been taken.
            means2d_grad: [N, 2] gradient of the loss by the projected means, per px; None where
                the render depends on no Gaussian: then there is nothing to accumulate.
            visible: [N] bool, whether this step's view shows the Gaussian.
            width: Width of the view, px.
            height: Height of the view, px.
            group: Group of the view; not read where there are no groups.
            hooks: What others decide at this step.

        Returns:
            The counts of what was done.

        Raises:
            KeyError: There are groups, and the view's is none of them.
        """
        settings = self.settings
        if step >= settings.stop:
            return Refinement()
        if means2d_grad is not None:
            row = self.group_rows[group] if self.group_rows else 0
            self._accumulate(row, means2d_grad, visible, width, height)
        refinement = Refinement()
        if step > settings.start and step % settings.every == 0:
            refinement = self._refine(step, self._deciding_thresholds(group), hooks)
        if step > 0 and step % settings.reset_every == 0:
            refinement = replace(refinement, reset=self._reset_opacities(hooks))
        return refinement

    @torch.no_grad()
    def remove(self, mask: Tensor) -> int:
        """Remove Gaussians with their moments and statistics, at any step.

        Args:
            mask: [N] bool, which Gaussians.

        Returns:
            The number of Gaussians that were removed.
        """
        keep = ~mask
        self._keep(keep)
        self.grad2d_sum = self.grad2d_sum[:, keep]
        self.visible_count = self.visible_count[:, keep]
        return int(mask.sum())

    def state_dict(self) -> dict[str, Any]:
        """Return the statistics so far, and the state of the random generator."""
        return {
            "grad2d_sum": self.grad2d_sum,
            "visible_count": self.visible_count,
            "generator": self.generator.get_state(),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Set statistics and random generator to those of `state_dict`.

        Args:
            state: A result of `state_dict`. The optimizer has loaded its Gaussians already.

        Raises:
            KeyError: A part of the state is missing.
            ValueError: The statistics are not of these groups and Gaussians.
        """
        self._clear_statistics()
        for name in ("grad2d_sum", "visible_count"):
            value, current = state[name], self.grad2d_sum
            if value.shape != current.shape or value.dtype != current.dtype:
                raise ValueError(f"{name}: {value.dtype} {list(value.shape)} does not fit")
        self.grad2d_sum, self.visible_count = state["grad2d_sum"], state["visible_count"]
        self.generator.set_state(state["generator"])

    def _deciding_thresholds(self, group: str) -> dict[str, Thresholds]:
        """Return thresholds for each of the G statistics, for a refinement after a group's view."""
        if self.per_group:
            return self.group_thresholds
        if self.group_thresholds:
            return {group: self.group_thresholds[group]}
        return {group: self.shared_thresholds}

    @torch.no_grad()
    def _refine(
        self, step: int, deciding: Mapping[str, Thresholds], hooks: DensifierHooks
    ) -> Refinement:
        """Drop what is not finite, grow, prune, and start the statistics again."""
        # Before growing would copy it, and before a hook renders.
        dropped = self.remove(~self._finite())
        above, high_gradient = self._above_thresholds(deciding)  # [G, N], [N]
        growing = self._choose(high_gradient, step, hooks)  # [N]
        deciding_row = self._deciding_row()  # [N], before growing
        grown, parents = self._grow(growing)
        prune = self.grad2d_sum.new_tensor([t.prune_opacity for t in deciding.values()])  # [G]
        # Copies and halves are pruned by the threshold of their parent.
        pruned, low_opacity = self._prune(
            prune, deciding_row[parents], prune_large=step > self.settings.reset_every
        )
        self._clear_statistics()
        by_group = {
            f"{count}_{name}": 0 for count in _COUNTED_BY_GROUP for name in self.group_thresholds
        }
        for row, name in enumerate(deciding if self.group_thresholds else ()):
            by_group[f"grown_{name}"] = int(above[row].sum())
            by_group[f"pruned_opacity_{name}"] = low_opacity[row]
        return Refinement(pruned_non_finite=dropped, **grown, **pruned, by_group=by_group)

    def _above_thresholds(self, deciding: Mapping[str, Thresholds]) -> tuple[Tensor, Tensor]:
        """Which Gaussians are above each growth threshold [G, N], and above the one that holds."""
        grow = self.grad2d_sum.new_tensor([t.grow_grad2d for t in deciding.values()])  # [G]
        mean_grad2d = self.grad2d_sum / self.visible_count.clamp_min(1)  # [G, N]
        above = mean_grad2d > grow[:, None]  # [G, N]
        if self.decide != "own_threshold":
            return above, above.any(dim=0)
        of_threshold = (self.grad2d_sum / grow[:, None]).sum(dim=0)  # [N]
        return above, of_threshold > self.visible_count.sum(dim=0)

    def _choose(self, candidates: Tensor, step: int, hooks: DensifierHooks) -> Tensor:
        """Return which of the candidates [N] grow.

        Args:
            candidates: [N] bool, Gaussians above the growth threshold.
            step: Number of the step.
            hooks: What others decide at this step.
        """
        may_grow = hooks.may_grow(self.gaussians)
        if may_grow is not None:
            candidates = candidates & may_grow
        if self.budget is None:
            return candidates
        start, last = self.settings.start, self.settings.last_refinement
        progress = (step - start) / (last - start)  # this step is above start, and at most last
        room = max(0, self.budget.cap(progress) - len(self.gaussians))
        if int(candidates.sum()) <= room:
            return candidates
        scores = hooks.growth_scores(self.gaussians) if room else None
        if scores is None:
            scores = self.grad2d_sum.sum(dim=0) / self.visible_count.sum(dim=0).clamp_min(1)
        return best(candidates, scores, room)

    @torch.no_grad()
    def _accumulate(
        self, row: int, means2d_grad: Tensor, visible: Tensor, width: int, height: int
    ) -> None:
        # gsplat's units: an image is 2 wide and 2 high, whatever its size in pixels.
        half_size = width / 2, height / 2
        accumulate = implementation("densify", self.optimizer.backend).accumulate_statistics
        sums = self.grad2d_sum[row], self.visible_count[row]
        accumulate(means2d_grad, visible, half_size, *sums)

    def _clear_statistics(self) -> None:
        count = len(self.group_thresholds) if self.per_group else 1
        self.grad2d_sum = self.gaussians.opacities.new_zeros(count, len(self.gaussians))
        self.visible_count = torch.zeros_like(self.grad2d_sum)

    def _finite(self) -> Tensor:
        """Return which Gaussians [N] are finite in all parameters and largest scale."""
        finite = torch.isfinite(self._largest_scale())  # [N]
        for name in PARAMETERS:
            finite &= torch.isfinite(self.gaussians[name][..., None]).flatten(1).all(dim=1)
        return finite

    def _deciding_row(self) -> Tensor:
        """Return the first statistic [N] that is not 0 of each Gaussian, or else the last."""
        has_gradient = self.grad2d_sum > 0  # [G, N]
        has_gradient[-1] = True
        return has_gradient.int().argmax(dim=0)

    def _grow(self, growing: Tensor) -> tuple[dict[str, int], Tensor]:
        """Duplicate or split where `growing` [N].

        Returns:
            Counts, and the former index [M] of each Gaussian that is there now, or of its parent.
        """
        split = growing
        if self.settings.split == "random":
            split = growing & (
                self._largest_scale() > self.settings.grow_scale3d * self.scene_scale
            )
        duplicate = growing & ~split
        copies = {name: self.gaussians[name][duplicate] for name in PARAMETERS}
        halves = self._halves({name: self.gaussians[name][split] for name in PARAMETERS})
        self._keep(~split)
        self.optimizer.append(
            {name: torch.cat([copies[name], halves[name]]) for name in PARAMETERS}
        )
        index = torch.arange(len(growing))
        parents = torch.cat([index[~split], index[duplicate], index[split].repeat(2)])
        return {"duplicated": int(duplicate.sum()), "split": int(split.sum())}, parents

    def _halves(self, old: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Return what replaces Gaussians that are split: raw parameters [2 M, ...] by name."""
        scales = self._activations.exp(old["scales"])  # [M, 3]
        if self.settings.split == "long_axis":
            return split_along_longest_axis(old, scales)
        return split_at_random(old, scales, self.generator)

    def _prune(
        self, thresholds: Tensor, deciding_row: Tensor, *, prune_large: bool
    ) -> tuple[dict[str, int], list[int]]:
        """Remove Gaussians with a low opacity, or too large.

        Args:
            thresholds: [G] opacities.
            deciding_row: [N] which of the thresholds each Gaussian is pruned by.
            prune_large: Whether Gaussians may be too large.

        Returns:
            Counts, and how many Gaussians each of the G thresholds removed.
        """
        low_opacity = (
            self._activations.logistic(self.gaussians.opacities) < thresholds[deciding_row]
        )  # [N]
        largest = self.settings.prune_scale3d * self.scene_scale if prune_large else math.inf
        too_large = ~low_opacity & (self._largest_scale() > largest)
        self._keep(~(low_opacity | too_large))
        counts = {
            "pruned_opacity": int(low_opacity.sum()),
            "pruned_scale": int(too_large.sum()),
        }
        by_row = torch.bincount(deciding_row[low_opacity], minlength=len(thresholds))
        return counts, by_row.tolist()

    @torch.no_grad()
    def _reset_opacities(self, hooks: DensifierHooks) -> int:
        """Cap opacities above every threshold, with moments of zero; return how many fell."""
        thresholds = self.group_thresholds.values() or [self.shared_thresholds]
        largest = max(threshold.prune_opacity for threshold in thresholds)
        cap_opacity = torch.tensor(self.settings.reset_opacity * largest, dtype=torch.float64)
        attenuation = hooks.opacity_attenuation(self.gaussians)  # [N]
        if attenuation is not None:
            cap_opacity = (cap_opacity / attenuation.double()).clamp(max=_OPAQUE)
        opacities = self.gaussians.opacities
        cap = torch.logit(cap_opacity).to(opacities)
        self.optimizer.reset("opacities", torch.minimum(opacities, cap))
        return int((opacities > cap).sum())

    @property
    def _activations(self) -> ModuleType:
        """The activation functions of the optimizer's backend."""
        return implementation("activations", self.optimizer.backend)

    def _largest_scale(self) -> Tensor:
        """Return the largest scale [N] of each Gaussian, world units."""
        largest: Tensor = self._activations.exp(self.gaussians.scales.amax(dim=-1))
        return largest

    def _keep(self, mask: Tensor) -> None:
        """Remove all Gaussians but those of `mask` [N]; nothing is copied where it is all true."""
        if not mask.all():
            self.optimizer.keep(mask)
