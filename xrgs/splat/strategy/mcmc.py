"""3D Gaussian Splatting as Markov chain Monte Carlo [kheradmand2024], as gsplat has it.

Given the same inputs and random draws, the results are those of `MCMCStrategy` of gsplat [ye2025]
1.5.3, to the rounding of float32. On the native backend the results do not depend on the number of
threads or on the processor.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, ClassVar

import torch
from torch import Tensor

from xrgs.splat.gaussians import PARAMETERS
from xrgs.splat.quaternions import rotate
from xrgs.splat.strategy.base import NO_HOOKS, Strategy
from xrgs.splat.strategy.ops import gaussians_of
from xrgs.splat.strategy.refinement import Refinement, StrategyHooks

GROWTH = 1.05
"""Factor by which a refinement raises the number of Gaussians."""
MOST_SHARES = 51
"""A Gaussian is shared out to as many at most; more are counted as so many."""
_OPAQUE = 1 - 2**-23
"""Gaussians with a higher opacity are shared out as if they had this one."""
_NOISE_STEEPNESS, _NOISE_OPACITY = 100, 0.995
"""Noise falls off around an opacity of 1 - 0.995, as a logistic function with this slope."""
_LEAST_NOISE = 2**-24
"""Gaussians with a smaller share of the noise, of an opacity above 0.17, stay where they are."""

_COEFFICIENTS = torch.tensor(
    [
        [(-1) ** (m - 1) * math.comb(n, m) / math.sqrt(m) for m in range(1, MOST_SHARES + 1)]
        for n in range(MOST_SHARES + 1)
    ],
    dtype=torch.float64,
    device="cpu",
)
"""The coefficient of o^m in `share_out` for n shares [n, m - 1]."""


class MCMCStrategy(Strategy):
    """Keeps a number of Gaussians, and moves the ones that show nothing to where others are.

    gsplat's `MCMCStrategy` (`strategy/mcmc.py`). At the steps above `start` and below `stop` that
    `every` divides,

    1. each dead Gaussian, with an opacity of at most `prune_opacity`, becomes a copy of a living
       one, which is drawn with a probability in proportion to its opacity;
    2. copies of Gaussians, drawn in the same way, are added until there are 5% more Gaussians, or
       as many as the budget says.

    A Gaussian and its copies share its opacity and scales (`share_out`), so that they render nearly
    as it did alone. Adam's moments of a Gaussian that is copied are set to zero by 1, and stay as
    they are by 2. The moments of a dead Gaussian stay, and the moments of an added one are zero.

    After every step of the run the means move by noise. With s the learning rate of means times
    `noise`, covariance C, opacity o and e normal with unit variance,

        mean += s / (1 + exp(-100 ((1 - o) - 0.995))) C e,

    so that Gaussians which are nearly transparent explore. There are no resets, no pruning and no
    rule against large Gaussians. gsplat's trainer adds penalties on opacities and scales
    (`xrgs.training.components.regularization`), without which few Gaussians die.

    Ours: the budget is in Gaussians for each pixel of the largest training view, where gsplat has a
    number. Gaussians that are not finite are removed at refinements, and grow again. Gaussians with
    an opacity above 0.17 get no noise, where gsplat's is below 6e-8 of s C e, which saves time.
    """

    asks_components: ClassVar[bool] = False

    def _begin(self) -> None:
        """Find the largest number of Gaussians.

        Raises:
            ValueError: There are groups, or no budget.
        """
        if self.groups is not None:
            raise ValueError("groups: there are no thresholds of growth")
        if not self.settings.budget:
            raise ValueError("settings.budget must be above 0: Gaussians are added up to it")
        self.most = gaussians_of(self.settings.budget, self.view_pixels)

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
        """Refine where the schedule says so, then add noise to the means."""
        del means2d_grad, visible, width, height, group, hooks
        settings, refinement = self.settings, Refinement()
        if settings.start < step < settings.stop and step % settings.every == 0:
            # First: nothing that is not finite can be drawn from.
            dropped = self.remove(~self._finite())
            refinement = Refinement(
                pruned_non_finite=dropped, relocated=self._relocate(), added=self._add()
            )
        self._move_means()
        return refinement

    def remove(self, mask: Tensor) -> int:
        """Remove the Gaussians of `mask` [N] with their moments."""
        self._keep(~mask)
        return int(mask.sum())

    def state_dict(self) -> dict[str, Any]:
        """Return the state of the random generator."""
        return {"generator": self.generator.get_state()}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore the state of the random generator."""
        self.generator.set_state(state["generator"])

    def _relocate(self) -> int:
        """Move the dead Gaussians to living ones; return how many."""
        opacities = self._opacities()
        is_dead = opacities <= self.settings.prune_opacity
        dead, living = (mask.nonzero()[:, 0] for mask in (is_dead, ~is_dead))
        if not (len(dead) and len(living)):
            return 0
        chosen = living[self._draw(opacities[living], len(dead))]
        self._share_out(chosen, opacities)
        for name in PARAMETERS:
            self.gaussians[name][dead] = self.gaussians[name][chosen]
        self.optimizer.forget(chosen)
        return len(dead)

    def _add(self) -> int:
        """Add Gaussians at others; return how many."""
        count, opacities = len(self.gaussians), self._opacities()
        added = min(self.most, int(GROWTH * count)) - count
        if added <= 0 or not opacities.any():
            return 0
        chosen = self._draw(opacities, added)
        self._share_out(chosen, opacities)
        self.optimizer.append({name: self.gaussians[name].detach()[chosen] for name in PARAMETERS})
        return added

    def _draw(self, opacities: Tensor, count: int) -> Tensor:
        """Draw indices [count] of opacities [N] in proportion to them, with repetition."""
        # In double: the sums of float32 depend on how torch adds.
        weights = opacities.double().cpu()  # where the generator is
        drawn = torch.multinomial(weights, count, replacement=True, generator=self.generator)
        return drawn.to(opacities.device)

    def _share_out(self, chosen: Tensor, opacities: Tensor) -> None:
        """Give the Gaussians `chosen` [M] the opacity and scales that they share with copies.

        Args:
            chosen: Indices, each as often as there will be copies of the Gaussian.
            opacities: [N] of all Gaussians.
        """
        gaussians = self.gaussians
        shares = torch.bincount(chosen, minlength=len(gaussians))[chosen] + 1  # [M]
        opacity, factor = share_out(opacities[chosen].double(), shares)
        logits = torch.logit(opacity.clamp_min(self.settings.prune_opacity))
        gaussians.opacities[chosen] = logits.to(gaussians.opacities)
        scales = gaussians.scales[chosen].double() + factor.log()[:, None]
        gaussians.scales[chosen] = scales.to(gaussians.scales)

    def _move_means(self) -> None:
        """Add the noise of a step to the means."""
        size = self.settings.noise * self.optimizer.rates["means"]
        if not size:
            return
        gaussians, activations = self.gaussians, self._activations
        exponents = _NOISE_STEEPNESS * ((1 - self._opacities()) - _NOISE_OPACITY)
        shares = activations.logistic(exponents)  # [N]
        moving = (shares > _LEAST_NOISE).nonzero()[:, 0]  # [M]
        # In double, since the numbers that torch draws in float32 depend on the processor. C e is
        # R S^2 (R' e), and R' e is as normal as e: it is drawn along the axes of the Gaussian.
        normal = torch.randn(len(moving), 3, generator=self.generator, dtype=torch.float64)
        variances = activations.exp(gaussians.scales[moving]).square()  # [M, 3]
        noise = normal.to(variances) * variances * (shares[moving] * size)[:, None]
        gaussians.means[moving] += rotate(gaussians.quats[moving], noise)

    def _opacities(self) -> Tensor:
        """Return the opacity [N] of each Gaussian."""
        opacities: Tensor = self._activations.logistic(self.gaussians.opacities)
        return opacities


def share_out(opacities: Tensor, shares: Tensor) -> tuple[Tensor, Tensor]:
    """Find what n Gaussians at one place have to be to render nearly as one does.

    Equation 9 of 3DGS-MCMC [kheradmand2024]. A Gaussian of opacity o and scales s is replaced by n
    Gaussians with

        o_n = 1 - (1 - o)^(1 / n),
        s_n = s o / (sum over m in 1..n of  (-1)^(m - 1) binomial(n, m) o_n^m / sqrt(m)),

    so that their composite has the opacity o at the centre and, along a line through it, the same
    integral. The paper and gsplat sum over i in 1..n and k in 0..i - 1 with binomial(i - 1, k);
    that sum over i is binomial(n, k + 1).

    Args:
        opacities: [M] float64 in 0..1.
        shares: [M] int64, n; at least 1.

    Returns:
        o_n [M], and s_n / s [M].
    """
    opacities = opacities.clamp_max(_OPAQUE)
    shares = shares.clamp_max(MOST_SHARES)
    shared = -torch.expm1(torch.log1p(-opacities) / shares)
    powers = shared[:, None].expand(-1, MOST_SHARES).cumprod(dim=1)  # [M, m - 1]
    coefficients = _COEFFICIENTS.to(shares.device)[shares]  # [M, m - 1]
    return shared, opacities / (coefficients * powers).sum(dim=1)
