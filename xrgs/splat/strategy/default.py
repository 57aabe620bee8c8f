"""Adaptive density control [kerbl2023, section 5.2] as in gsplat's default strategy.

Given the same inputs, the results are those of `DefaultStrategy` of gsplat [ye2025] 1.5.3, with two
exceptions:

- Opacities are reset. By mistake, gsplat 1.5.3 never resets them: Python reads its condition
  `step % reset_every == 0 & step > 0` as a comparison with `0 & step` (pull request 776 fixes it).
  `DensifySettings.resets` of False is the behaviour of 1.5.3.
- A split draws its random numbers in double.

On the native backend the results do not depend on the number of threads or on the processor.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from xrgs.splat.gaussians import PARAMETERS
from xrgs.splat.strategy.base import NO_HOOKS, Refinement, Strategy, StrategyHooks, Thresholds
from xrgs.splat.strategy.ops import (
    Budget,
    gaussians_of,
    split_along_longest_axis,
    split_at_random,
    top_k,
)

_OPAQUE = 1 - 2**-24
"""The largest opacity whose logit is finite in float32."""

_COUNTED_BY_GROUP = ("grown", "pruned_opacity")


class DefaultStrategy(Strategy):
    """Grows Gaussians by their image-plane gradient: the method of 3D Gaussian Splatting.

    gsplat's `DefaultStrategy` (`strategy/default.py`):

    - It refines at steps above `start` and below `stop` that are a multiple of `every`. A Gaussian
      grows if the norm of its image-plane gradient, averaged over the views that showed it since
      the last refinement, is above `grow_grad2d`.
    - A growing Gaussian is duplicated if its largest scale is at most `grow_scale3d * scene_scale`,
      else split in two.
    - Then it prunes Gaussians with an opacity below `prune_opacity` and, after step `reset_every`,
      those with a scale above `prune_scale3d * scene_scale`.
    - At steps above 0 and below `stop` that are a multiple of `reset_every`, it caps opacities at
      `reset_opacity * prune_opacity`, unless `resets` is False.

    Three options are not in gsplat:

    - `split=long_axis` splits every growing Gaussian along its longest axis.
    - With a budget (`xrgs.splat.strategy.ops.Budget`) only the Gaussians with the highest scores
      grow, up to the cap at this refinement. Nothing is removed to meet the budget; pruning makes
      room for the next refinement.
    - `groups` replaces `grow_grad2d` and `prune_opacity` by thresholds for each group of views.

    Attributes:
        grad2d_sum: [G, N] sum of the norms of the image-plane gradients, in normalised device
            units. G is the number of groups if each has its own statistics, else 1.
        visible_count: [G, N] number of views in the sum.

    Examples:
        >>> strategy = DefaultStrategy(  # doctest: +SKIP
        ...     optimizer, settings, scene_scale=1.0, generator=torch.Generator()
        ... )
        >>> for step in range(steps):  # doctest: +SKIP
        ...     offset = torch.zeros(len(gaussians), 2, requires_grad=True)
        ...     render = rasterize_parameters(..., means2d_offset=offset)
        ...     photometric_loss(render.image, target, l1=0.8, ssim=0.2).backward()
        ...     optimizer.step(camera)
        ...     strategy.after_step(step, offset.grad, render.visible, width=w, height=h)
    """

    def _begin(self) -> None:
        """Start with empty statistics."""
        settings, groups = self.settings, self.groups
        self.budget = (
            Budget(len(self.gaussians), gaussians_of(settings.budget, self.view_pixels))
            if settings.budget
            else None
        )
        self.shared_thresholds = Thresholds(settings.grow_grad2d, settings.prune_opacity)
        self.group_thresholds = {} if groups is None else dict(groups.thresholds)
        self.decide = "current_view" if groups is None else groups.decide
        self.per_group = self.decide != "current_view"
        #: Group -> row of the G statistics for its views.
        self.group_rows = {
            name: row if self.per_group else 0 for row, name in enumerate(self.group_thresholds)
        }
        self.grad2d_sum: Tensor
        self.visible_count: Tensor
        self._clear_statistics()

    @torch.no_grad()
    def after_step(
        self,
        step: int,
        means2d_grad: Tensor | None,
        visible: Tensor,
        *,
        width: int,
        height: int,
        group: str = "",
        hooks: StrategyHooks = NO_HOOKS,
    ) -> Refinement:
        """Add the step to the statistics; refine and reset if it is due."""
        settings = self.settings
        if step >= settings.stop:
            return Refinement()
        if means2d_grad is not None:
            row = self.group_rows[group] if self.group_rows else 0
            # Normalised device units, as in gsplat: every image is 2 wide and 2 high.
            half_size = width / 2, height / 2
            sums = self.grad2d_sum[row], self.visible_count[row]
            self._elementwise.accumulate_statistics(means2d_grad, visible, half_size, *sums)
        refinement = Refinement()
        if step > settings.start and step % settings.every == 0:
            refinement = self._refine(step, self._deciding_thresholds(group), hooks)
        if settings.resets and step > 0 and step % settings.reset_every == 0:
            refinement = replace(refinement, reset=self._reset_opacities(hooks))
        return refinement

    @torch.no_grad()
    def remove(self, mask: Tensor) -> int:
        """Remove the Gaussians of `mask` [N] with their moments and statistics."""
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
        """Restore the statistics and the state of the random generator."""
        self._clear_statistics()
        for name in ("grad2d_sum", "visible_count"):
            value, current = state[name], self.grad2d_sum
            if value.shape != current.shape or value.dtype != current.dtype:
                raise ValueError(
                    f"{name} must be {current.dtype} {list(current.shape)}, got {value.dtype}"
                    f" {list(value.shape)}"
                )
        for name in ("grad2d_sum", "visible_count"):
            setattr(self, name, state[name].to(self.gaussians.means.device))
        self.generator.set_state(state["generator"])

    def _deciding_thresholds(self, group: str) -> dict[str, Thresholds]:
        """Return the thresholds for the G statistics, at a refinement after a view of `group`."""
        if self.per_group:
            return self.group_thresholds
        if self.group_thresholds:
            return {group: self.group_thresholds[group]}
        return {group: self.shared_thresholds}

    def _refine(
        self, step: int, deciding: Mapping[str, Thresholds], hooks: StrategyHooks
    ) -> Refinement:
        """Remove Gaussians that are not finite, grow, prune, and clear the statistics."""
        # Remove first, so that such Gaussians are neither copied nor rendered by a hook.
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
        """Return which Gaussians are above each growth threshold [G, N], and which are to grow [N].

        The second result combines the G statistics as `Groups.decide` says.
        """
        grow = self.grad2d_sum.new_tensor([t.grow_grad2d for t in deciding.values()])  # [G]
        mean_grad2d = self.grad2d_sum / self.visible_count.clamp_min(1)  # [G, N]
        above = mean_grad2d > grow[:, None]  # [G, N]
        if self.decide != "own_threshold":
            return above, above.any(dim=0)
        of_threshold = (self.grad2d_sum / grow[:, None]).sum(dim=0)  # [N]
        return above, of_threshold > self.visible_count.sum(dim=0)

    def _choose(self, candidates: Tensor, step: int, hooks: StrategyHooks) -> Tensor:
        """Return which of the `candidates` [N], the Gaussians above the growth threshold, grow."""
        may_grow = hooks.may_grow(self.gaussians)
        if may_grow is not None:
            candidates = candidates & may_grow
        if self.budget is None:
            return candidates
        start, last = self.settings.start, self.settings.last_refinement
        progress = (step - start) / (last - start)  # start < step <= last
        room = max(0, self.budget.cap(progress) - len(self.gaussians))
        if int(candidates.sum()) <= room:
            return candidates
        scores = hooks.growth_scores(self.gaussians) if room else None
        if scores is None:
            scores = self.grad2d_sum.sum(dim=0) / self.visible_count.sum(dim=0).clamp_min(1)
        return top_k(candidates, scores, room)

    def _clear_statistics(self) -> None:
        count = len(self.group_thresholds) if self.per_group else 1
        self.grad2d_sum = self.gaussians.opacities.new_zeros(count, len(self.gaussians))
        self.visible_count = torch.zeros_like(self.grad2d_sum)

    def _deciding_row(self) -> Tensor:
        """Return for each Gaussian [N] the first row with a gradient sum above 0, else the last."""
        has_gradient = self.grad2d_sum > 0  # [G, N]
        has_gradient[-1] = True
        return has_gradient.int().argmax(dim=0)

    def _grow(self, growing: Tensor) -> tuple[dict[str, int], Tensor]:
        """Duplicate or split the Gaussians `growing` [N].

        Returns:
            The counts, and for each of the M present Gaussians its former index or its parent's.
        """
        split = growing
        if self.settings.split == "random":
            split = growing & (
                self._largest_scale() > self.settings.grow_scale3d * self.scene_scale
            )
        duplicate = growing & ~split
        copies = {name: self.gaussians[name][duplicate] for name in PARAMETERS}
        old = {name: self.gaussians[name][split] for name in PARAMETERS}
        scales = self._elementwise.exp(old["scales"])  # [M, 3]
        halves = (
            split_along_longest_axis(old, scales)
            if self.settings.split == "long_axis"
            else split_at_random(old, scales, self.generator)
        )
        self._keep(~split)
        self.optimizer.append(
            {name: torch.cat([copies[name], halves[name]]) for name in PARAMETERS}
        )
        index = torch.arange(len(growing), device=growing.device)
        parents = torch.cat([index[~split], index[duplicate], index[split].repeat(2)])
        return {"duplicated": int(duplicate.sum()), "split": int(split.sum())}, parents

    def _prune(
        self, thresholds: Tensor, deciding_row: Tensor, *, prune_large: bool
    ) -> tuple[dict[str, int], list[int]]:
        """Remove Gaussians of an opacity below `thresholds[deciding_row]`, or that are too large.

        Returns:
            The counts, and the number of Gaussians that each of the G thresholds removed.
        """
        low_opacity = (
            self._elementwise.logistic(self.gaussians.opacities) < thresholds[deciding_row]
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

    def _reset_opacities(self, hooks: StrategyHooks) -> int:
        """Cap the opacities and set their moments to zero; return how many were above the cap."""
        # The cap must be above every group's threshold, or the next refinement would prune.
        thresholds = self.group_thresholds.values() or [self.shared_thresholds]
        largest = max(threshold.prune_opacity for threshold in thresholds)
        cap_opacity = torch.tensor(self.settings.reset_opacity * largest, dtype=torch.float64)
        # If renders attenuate opacities, cap the attenuated ones, as Mip-Splatting [yu2024] does: a
        # cap on the raw ones would leave Gaussians that are too faint to be rendered.
        attenuation = hooks.opacity_attenuation(self.gaussians)  # [N]
        if attenuation is not None:
            cap_opacity = (cap_opacity / attenuation.double()).clamp(max=_OPAQUE)
        opacities = self.gaussians.opacities
        cap = torch.logit(cap_opacity).to(opacities)
        self.optimizer.reset("opacities", torch.minimum(opacities, cap))
        return int((opacities > cap).sum())
