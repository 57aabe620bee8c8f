"""Where Gaussians come from and go to: gsplat's `DefaultStrategy`, on the same inputs the same.

One thing is as gsplat means it and not as its release 1.5.3 does it: there the opacity reset never
happens, since `step % reset_every == 0 & step > 0` compares with `0 & step` (its pull request 776
mends it).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from torch import Tensor

from xrgs.splat.gaussians import PARAMETERS
from xrgs.splat.optimizer import SplatOptimizer
from xrgs.splat.settings import DensifySettings
from xrgs.splat.torch.projection import rotations

SPLIT_SHRINK = 1.6
"""How many times smaller than the Gaussian it replaces each of a split's two is."""

_BY_GROUP = ("grown", "pruned_opacity")


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
    by_group: Mapping[str, int] = field(default_factory=dict)
    """Where views are told apart: `grown_<group>`, those above the group's threshold (one above two
    counts in both), and `pruned_opacity_<group>`, those below its."""

    @property
    def removed(self) -> int:
        """Gaussians gone, those that a split replaced aside."""
        return self.pruned_non_finite + self.pruned_opacity + self.pruned_scale

    def counts(self) -> dict[str, int]:
        """All of it by name, groups' behind the rules'."""
        rules = {name: value for name, value in vars(self).items() if name != "by_group"}
        return rules | dict(self.by_group)


@dataclass(frozen=True)
class Thresholds:
    """What a Gaussian must be above to grow, and not below to stay."""

    grow_grad2d: float
    prune_opacity: float


@dataclass(frozen=True)
class Groups:
    """Views that densification tells apart, each group with thresholds of its own.

    Not `pooled`, each group has statistics of its own. A Gaussian grows where any group's are above
    that group's threshold. It is pruned by the threshold of one group: the first, in the order
    given, in a view of which it had an image-plane gradient since the last refinement (being in the
    view's frustum is not enough: of a forward-facing scene every Gaussian is in every frustum); the
    last where it had none at all.

    `pooled`, there is one statistic of all views, and the view of the step at which Gaussians are
    refined sets both thresholds.
    """

    thresholds: Mapping[str, Thresholds]
    pooled: bool = False


class Densifier:
    """Grows, prunes and resets Gaussians by the statistics of the steps since it last did.

    At steps above `start` and below `stop` that `every` divides: those whose image-plane gradient,
    averaged over the views that saw them, is above `grow_grad2d` are duplicated (largest scale at
    most `grow_scale3d * scene_scale`) or split in two; then those with an opacity below
    `prune_opacity` are removed, and after step `reset_every` those with a scale above
    `prune_scale3d * scene_scale`. At steps above 0 that `reset_every` divides, opacities are capped
    at `reset_opacity * prune_opacity`. With none left, all of it is a no-op.

    `groups` may put thresholds of their own in place of `grow_grad2d` and `prune_opacity`; the cap
    is then that of the largest, since opacities below a threshold would all be pruned.

    Attributes:
        gradient: [G, N] sum of the norms of the image-plane gradients, in normalised device units;
            G statistics, 1 unless groups have their own.
        seen: [G, N] views that they are the sum of.
    """

    def __init__(
        self,
        optimizer: SplatOptimizer,
        settings: DensifySettings,
        *,
        scene_scale: float,
        generator: torch.Generator,
        groups: Groups | None = None,
    ) -> None:
        """Start with empty statistics.

        Args:
            optimizer: Of the Gaussians to densify.
            settings: Already scaled to the run's length.
            scene_scale: World units.
            generator: Draws where the halves of a split go.
            groups: Of views; None treats all alike, by the thresholds of `settings`.
        """
        self.optimizer = optimizer
        self.gaussians = optimizer.gaussians
        self.settings = settings
        self.scene_scale = scene_scale
        self.generator = generator
        self.alike = Thresholds(settings.grow_grad2d, settings.prune_opacity)
        self.thresholds = {} if groups is None else dict(groups.thresholds)
        self.apart = groups is not None and not groups.pooled
        #: Which of the G statistics a view of each group adds to.
        self.rows = {name: row if self.apart else 0 for row, name in enumerate(self.thresholds)}
        self.gradient: Tensor
        self.seen: Tensor
        self._forget()

    def after_step(
        self,
        step: int,
        means2d_grad: Tensor | None,
        visible: Tensor,
        *,
        width: int,
        height: int,
        group: str = "",
    ) -> Refinement:
        """Note a step's statistics and, when it is time, refine and reset.

        Args:
            step: From 0, after the optimizer's step.
            means2d_grad: [N, 2] gradient of the loss by the projected means, per px; None where
                the render depends on no Gaussian, and then nothing is noted.
            visible: [N] bool, seen by this step's view.
            width: Of the view, px.
            height: Of the view, px.
            group: Of the view; no matter where all are alike.

        Returns:
            What was done.

        Raises:
            KeyError: There are groups, and the view's is none of them.
        """
        settings = self.settings
        if step >= settings.stop:
            return Refinement()
        if means2d_grad is not None:
            row = self.rows[group] if self.rows else 0
            self._observe(row, means2d_grad, visible, width, height)
        done = Refinement()
        if step > settings.start and step % settings.every == 0:
            done = self._refine(self._deciding(group), too_large=step > settings.reset_every)
        if step > 0 and step % settings.reset_every == 0:
            done = replace(done, reset=self._reset_opacities())
        return done

    def state_dict(self) -> dict[str, Any]:
        """The statistics so far, and where chance stands."""
        generator = self.generator.get_state()
        return {"gradient": self.gradient, "seen": self.seen, "generator": generator}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Statistics and chance as `state_dict` told of them; the Gaussians are there already.

        Raises:
            KeyError: One is missing.
            ValueError: The statistics are not of these groups and Gaussians.
        """
        self._forget()
        for name in ("gradient", "seen"):
            value, here = state[name], self.gradient
            if value.shape != here.shape or value.dtype != here.dtype:
                raise ValueError(f"{name}: {value.dtype} {list(value.shape)} does not fit")
        self.gradient, self.seen = state["gradient"], state["seen"]
        self.generator.set_state(state["generator"])

    def _deciding(self, group: str) -> dict[str, Thresholds]:
        """Thresholds for each of the G statistics, at the refinement after a view of a group."""
        if self.apart:
            return self.thresholds
        return {group: self.thresholds[group] if self.thresholds else self.alike}

    @torch.no_grad()
    def _refine(self, deciding: Mapping[str, Thresholds], *, too_large: bool) -> Refinement:
        counts = {"pruned_non_finite": self._drop_non_finite()}
        grow = self.gradient.new_tensor([t.grow_grad2d for t in deciding.values()])  # [G]
        above = self.gradient / self.seen.clamp_min(1) > grow[:, None]  # [G, N]
        owner = self._owner()  # before growing: what is new has its parent's
        grown, parents = self._grow(above.any(dim=0))
        prune = self.gradient.new_tensor([t.prune_opacity for t in deciding.values()])
        pruned, faint = self._prune(prune, owner[parents], too_large=too_large)
        self._forget()
        by_group = {f"{what}_{name}": 0 for what in _BY_GROUP for name in self.thresholds}
        for row, name in enumerate(deciding if self.thresholds else ()):
            by_group[f"grown_{name}"] = int(above[row].sum())
            by_group[f"pruned_opacity_{name}"] = faint[row]
        return Refinement(**counts, **grown, **pruned, by_group=by_group)

    @torch.no_grad()
    def _observe(
        self, row: int, means2d_grad: Tensor, visible: Tensor, width: int, height: int
    ) -> None:
        # gsplat's units: an image is 2 wide and 2 high, whatever its size in pixels.
        units = width / 2, height / 2
        gradient, seen = self.gradient[row], self.seen[row]
        if self.optimizer.native:
            from xrgs.splat.native import densify as native_densify

            native_densify.observe(means2d_grad, visible, units, gradient, seen)
            return
        scaled = means2d_grad * means2d_grad.new_tensor(units)
        gradient += torch.where(visible, scaled.norm(dim=-1), 0)
        seen += visible

    def _forget(self) -> None:
        count = len(self.thresholds) if self.apart else 1
        self.gradient = self.gaussians.opacities.new_zeros(count, len(self.gaussians))
        self.seen = torch.zeros_like(self.gradient)

    @torch.no_grad()
    def _drop_non_finite(self) -> int:
        """Before growing, so that they leave no copies. Returns how many."""
        finite = torch.isfinite(self._largest_scale())
        for name in PARAMETERS:
            finite &= torch.isfinite(self.gaussians[name][..., None]).flatten(1).all(dim=1)
        self._keep(finite)
        self.gradient, self.seen = self.gradient[:, finite], self.seen[:, finite]
        return int((~finite).sum())

    def _owner(self) -> Tensor:
        """[N] the first statistic that is not 0 of each Gaussian, or else the last."""
        reached = self.gradient > 0
        reached[-1] = True
        return reached.int().argmax(dim=0)

    def _grow(self, high: Tensor) -> tuple[dict[str, int], Tensor]:
        """Duplicate or split these [N]; counts, and the parent [M] of each there is now."""
        small = self._largest_scale() <= self.settings.grow_scale3d * self.scene_scale
        duplicate, split = high & small, high & ~small
        copies = {name: self.gaussians[name][duplicate] for name in PARAMETERS}
        halves = self._halves(split)
        self._keep(~split)
        self.optimizer.append(
            {name: torch.cat([copies[name], halves[name]]) for name in PARAMETERS}
        )
        index = torch.arange(len(high))
        parents = torch.cat([index[~split], index[duplicate], index[split].repeat(2)])
        return {"duplicated": int(duplicate.sum()), "split": int(split.sum())}, parents

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

    def _prune(
        self, thresholds: Tensor, owner: Tensor, *, too_large: bool
    ) -> tuple[dict[str, int], list[int]]:
        """Counts, and how many each of `thresholds` [G] removed, of those that it owns [N]."""
        faint = torch.sigmoid(self.gaussians.opacities) < thresholds[owner]
        limit = self.settings.prune_scale3d * self.scene_scale if too_large else math.inf
        large = ~faint & (self._largest_scale() > limit)
        self._keep(~(faint | large))
        counts = {"pruned_opacity": int(faint.sum()), "pruned_scale": int(large.sum())}
        return counts, torch.bincount(owner[faint], minlength=len(thresholds)).tolist()

    @torch.no_grad()
    def _reset_opacities(self) -> int:
        thresholds = self.thresholds.values() or [self.alike]
        largest = max(threshold.prune_opacity for threshold in thresholds)
        value = torch.tensor(self.settings.reset_opacity * largest)
        cap = torch.logit(value).item()
        opacities = self.gaussians.opacities
        self.optimizer.reset("opacities", opacities.clamp(max=cap))
        return int((opacities > cap).sum())

    def _largest_scale(self) -> Tensor:
        """[N], world units."""
        return self.gaussians.scales.exp().amax(dim=-1)

    def _keep(self, mask: Tensor) -> None:
        """Remove all Gaussians but these [N]; most often none, and then nothing is copied."""
        if not mask.all():
            self.optimizer.keep(mask)
