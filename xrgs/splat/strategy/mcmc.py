"""3D Gaussian Splatting as Markov chain Monte Carlo [kheradmand2024], as in gsplat.

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
from xrgs.splat.strategy.base import NO_HOOKS, Refinement, Strategy, StrategyHooks
from xrgs.splat.strategy.ops import gaussians_of

GROWTH = 1.05
"""Factor by which a refinement raises the number of Gaussians."""
MOST_SHARES = 51
"""Limit of n in `share_out`, as in 3DGS-MCMC; larger numbers of copies are cut to it."""
_OPAQUE = 1 - 2**-23
"""Cap of the opacities in `share_out`."""
_NOISE_STEEPNESS, _NOISE_OPACITY = 100, 0.995
"""The noise falls with opacity as a logistic function of slope 100, centred at 1 - 0.995."""
_LEAST_NOISE = 2**-24
"""Gaussians whose noise factor is smaller (opacity above 0.17) get no noise."""

_COEFFICIENTS = torch.tensor(
    [
        [(-1) ** (m - 1) * math.comb(n, m) / math.sqrt(m) for m in range(1, MOST_SHARES + 1)]
        for n in range(MOST_SHARES + 1)
    ],
    dtype=torch.float64,
    device="cpu",
)
"""[n, m - 1] coefficient of o_n^m in the sum of `share_out`."""


class MCMCStrategy(Strategy):
    """Moves transparent Gaussians to opaque ones, adds Gaussians up to a budget, and adds noise.

    gsplat's `MCMCStrategy` (`strategy/mcmc.py`). At steps above `start` and below `stop` that are a
    multiple of `every`,

    1. each dead Gaussian, with an opacity of at most `prune_opacity`, becomes a copy of a living
       one, which is drawn with a probability in proportion to its opacity;
    2. copies of Gaussians, drawn in the same way, are added until there are 5% more Gaussians or
       the budget is reached.

    A Gaussian and its copies share its opacity and scales (`share_out`), so that together they
    render nearly as the Gaussian did. Adam's moments of a copied Gaussian are set to zero in 1, and
    kept in 2. A relocated Gaussian keeps its own moments; an added one starts with zero.

    After every step of the run the means move by noise. With s the learning rate of means times
    `noise`, covariance C, opacity o and e normal with unit variance,

        mean += s / (1 + exp(-100 ((1 - o) - 0.995))) C e,

    so that nearly transparent Gaussians explore. There are no resets and no pruning. gsplat's
    trainer adds penalties on opacities and scales (`xrgs.training.components.regularization`);
    without them few Gaussians die.

    Differences from gsplat: the budget is per pixel of the largest training view, not a number of
    Gaussians. Refinements remove Gaussians that are not finite and add others in their place. To
    save time, Gaussians with an opacity above 0.17 get no noise; gsplat's is below 6e-8 s C e.
    """

    asks_components: ClassVar[bool] = False

    def _begin(self) -> None:
        """Compute the largest number of Gaussians from the budget.

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
        """Refine if it is due, then add noise to the means."""
        del means2d_grad, visible, width, height, group, hooks
        settings, refinement = self.settings, Refinement()
        if settings.start < step < settings.stop and step % settings.every == 0:
            # Remove first: opacities that are not finite are no probabilities.
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
        """Move the dead Gaussians to living ones; return the number moved."""
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
        """Add copies of Gaussians; return the number added."""
        count, opacities = len(self.gaussians), self._opacities()
        added = min(self.most, int(GROWTH * count)) - count
        if added <= 0 or not opacities.any():
            return 0
        chosen = self._draw(opacities, added)
        self._share_out(chosen, opacities)
        self.optimizer.append({name: self.gaussians[name].detach()[chosen] for name in PARAMETERS})
        return added

    def _draw(self, opacities: Tensor, count: int) -> Tensor:
        """Draw indices [count] with repetition, with probabilities in proportion to `opacities`."""
        # In double, since float32 sums depend on the order in which torch adds.
        weights = opacities.double().cpu()  # on the generator's device
        drawn = torch.multinomial(weights, count, replacement=True, generator=self.generator)
        return drawn.to(opacities.device)

    def _share_out(self, chosen: Tensor, opacities: Tensor) -> None:
        """Set opacity and scales of Gaussians before they are copied (`share_out`).

        Args:
            chosen: [M] indices; a Gaussian's index is repeated for each of its copies.
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
        gaussians, activations = self.gaussians, self._elementwise
        exponents = _NOISE_STEEPNESS * ((1 - self._opacities()) - _NOISE_OPACITY)
        shares = activations.logistic(exponents)  # [N]
        moving = (shares > _LEAST_NOISE).nonzero()[:, 0]  # [M]
        # In double, since the numbers that torch draws in float32 depend on the processor. C e is
        # R S^2 (R^T e), and R^T e has the distribution of e: so R^T e is drawn directly.
        normal = torch.randn(len(moving), 3, generator=self.generator, dtype=torch.float64)
        variances = activations.exp(gaussians.scales[moving]).square()  # [M, 3]
        noise = normal.to(variances) * variances * (shares[moving] * size)[:, None]
        gaussians.means[moving] += rotate(gaussians.quats[moving], noise)

    def _opacities(self) -> Tensor:
        """Return the opacity [N] of each Gaussian."""
        opacities: Tensor = self._elementwise.logistic(self.gaussians.opacities)
        return opacities


def share_out(opacities: Tensor, shares: Tensor) -> tuple[Tensor, Tensor]:
    """Return opacity and scale factor of n equal Gaussians that together render nearly as one.

    Equation 9 of 3DGS-MCMC [kheradmand2024]. A Gaussian of opacity o and scales s is replaced by n
    Gaussians with

        o_n = 1 - (1 - o)^(1 / n),
        s_n = s o / (sum over m in 1..n of  (-1)^(m - 1) binomial(n, m) o_n^m / sqrt(m)),

    so that their composite has the opacity o at the centre and, along a line through it, the same
    integral. The paper and gsplat sum over i in 1..n and k in 0..i - 1 with binomial(i - 1, k);
    that sum over i is binomial(n, k + 1).

    Args:
        opacities: [M] float64 in 0..1.
        shares: [M] int64, the number n of Gaussians, at least 1.

    Returns:
        o_n [M], and s_n / s [M].
    """
    opacities = opacities.clamp_max(_OPAQUE)
    shares = shares.clamp_max(MOST_SHARES)
    shared = -torch.expm1(torch.log1p(-opacities) / shares)
    powers = shared[:, None].expand(-1, MOST_SHARES).cumprod(dim=1)  # [M, m - 1]
    coefficients = _COEFFICIENTS.to(shares.device)[shares]  # [M, m - 1]
    return shared, opacities / (coefficients * powers).sum(dim=1)
