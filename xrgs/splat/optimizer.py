"""Adam over the six parameters of the Gaussians, and its state as Gaussians come and go."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

import torch
from torch import Tensor

from xrgs.splat.backend import resolve_backend
from xrgs.splat.gaussians import PARAMETERS, Gaussians
from xrgs.splat.settings import OptimizerSettings


class SplatOptimizer:
    """One `torch.optim.Adam` with a named group a parameter, at gsplat's rates (`simple_trainer`).

    The rate of `means` is in units of the scene and decays exponentially, from
    `settings.means * scene_scale` at the first step to `settings.means_final` of it after the last.
    The state is torch's own: `adam.state[gaussians.means]["exp_avg"]`.

    Gaussians are added and removed through `append` and `keep` alone, so that parameters and state
    can't come apart. New ones start with moments of zero, under the step count of the old, as in
    gsplat.
    """

    def __init__(
        self,
        gaussians: Gaussians,
        settings: OptimizerSettings,
        *,
        scene_scale: float,
        steps: int,
        backend: str = "torch",
    ) -> None:
        """Start with no state.

        Args:
            gaussians: What to optimize; their tensors are replaced as Gaussians come and go.
            settings: Rates and Adam's constants.
            scene_scale: World units, above 0.
            steps: Of the whole run.
            backend: `torch`, `native` or `auto` (`resolve_backend`): who computes a step.

        Raises:
            ValueError: `scene_scale` or `steps` isn't above 0.
        """
        if not (math.isfinite(scene_scale) and scene_scale > 0):
            raise ValueError(f"scene_scale must be above 0, got {scene_scale}")
        if steps < 1:
            raise ValueError(f"steps must be at least 1, got {steps}")
        self.gaussians = gaussians
        self.means_rate = settings.means * scene_scale
        self.means_final = settings.means_final
        self.steps = steps
        self.steps_done = 0
        self.native = resolve_backend(backend) == "native"
        rates = {name: getattr(settings, name) for name in PARAMETERS}
        rates["means"] = self.means_rate
        self.adam = torch.optim.Adam(
            [{"name": name, "params": [gaussians[name]], "lr": rates[name]} for name in PARAMETERS],
            betas=(settings.beta1, settings.beta2),
            eps=settings.eps,
            fused=True,  # a fifth of the default's time, and as exact
        )

    def step(self) -> None:
        """Move every parameter that has a gradient, then decay the rate of `means`."""
        if self.native:
            from xrgs.splat import native_adam

            native_adam.step(self.adam)
        else:
            self.adam.step()
        self.steps_done += 1
        decay: float = self.means_final ** (self.steps_done / self.steps)
        self._group("means")["lr"] = self.means_rate * decay

    def zero_grad(self) -> None:
        """Forget the gradients."""
        self.adam.zero_grad()

    def state_bytes(self) -> int:
        """Bytes of Adam's state."""
        return sum(value.nbytes for state in self.adam.state.values() for value in state.values())

    def keep(self, index: Tensor) -> None:
        """Only these Gaussians remain, in this order.

        Args:
            index: [M] int64 indices, or [N] bool.
        """
        for name in PARAMETERS:
            kept = self.gaussians[name].detach()[index]
            self._replace(name, kept, lambda moment: moment[index])

    def append(self, new: Mapping[str, Tensor]) -> None:
        """Add Gaussians behind the present ones.

        Args:
            new: [M, ...] for each name of `PARAMETERS`.
        """
        count = len(new["means"])

        def lengthen(moment: Tensor) -> Tensor:
            return torch.cat([moment, moment.new_zeros(count, *moment.shape[1:])])

        for name in PARAMETERS:
            longer = torch.cat([self.gaussians[name].detach(), new[name]])
            self._replace(name, longer, lengthen)

    def reset(self, name: str, value: Tensor) -> None:
        """Give one parameter [N, ...] new values and moments of zero."""
        self._replace(name, value, torch.zeros_like)

    def _replace(self, name: str, value: Tensor, moment: Callable[[Tensor], Tensor]) -> None:
        """Put `value` in a parameter's place, and `moment` of each of its Adam moments."""
        state = self.adam.state.pop(self.gaussians[name], {})
        leaf = value.detach().requires_grad_()
        self.gaussians[name] = leaf
        self._group(name)["params"] = [leaf]
        if state:  # none before the first step
            moments = {key: moment(state[key]) for key in ("exp_avg", "exp_avg_sq")}
            self.adam.state[leaf] = state | moments

    def _group(self, name: str) -> dict[str, object]:
        return self.adam.param_groups[PARAMETERS.index(name)]
