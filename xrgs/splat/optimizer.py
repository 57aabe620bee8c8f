"""Adam over the six parameters of the Gaussians, whose state follows as Gaussians come and go."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import torch
from torch import Tensor

from xrgs.splat.backend import implementation, resolve_backend
from xrgs.splat.cameras import Camera
from xrgs.splat.gaussians import PARAMETERS, Gaussians
from xrgs.splat.settings import NOMINAL_STEPS, OptimizerSettings


class SplatOptimizer:
    """One `torch.optim.Adam` with a named group for each parameter, at gsplat's learning rates.

    The rates are from gsplat's `examples/simple_trainer.py`. The rate of `means` after t steps is

        rate(t) = means * scene_scale * means_final^(max(0, t - t0) / (steps - t0))

    where t0 is `means_decay_from * steps / 30,000`, 0 in gsplat. DashGaussian [chen2025dash] lets
    the decay wait while it trains at a reduced resolution.

    With `shN_every` of k, the harmonics above band 0 move at every k-th step alone, the first one
    included, by the gradient of that step, and at k times their rate. Their moments are updated at
    these steps alone. Our choice: the gradients of the other steps are never computed, and the rate
    has the factor k. Adam's steps do not depend on the size of the gradient, so that a coefficient
    with a gradient of constant sign goes as far as with k = 1.

    Gaussians are added and removed through `append` and `keep` alone, so that parameters and state
    always fit. New Gaussians start with moments of zero and the step count of the others, as in
    gsplat (`strategy/ops.py`).

    Attributes:
        adam: Holds groups and state: `adam.state[gaussians.means]["exp_avg"]`.
        backend: `torch` or `native`: the backend that computes a step.
        gaussians: The optimized Gaussians.
        steps_done: Number of training steps so far, with the steps that `skip_step` counted.
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
            gaussians: The Gaussians to optimize, whose tensors are replaced as Gaussians come and
                go.
            settings: Learning rates and Adam's constants.
            scene_scale: Extent of the scene in world units, above 0.
            steps: Number of steps of the whole run, at least 1.
            backend: `torch`, `native` or `auto` (`resolve_backend`), which computes the steps.

        Raises:
            ValueError: `scene_scale` or `steps` is not above 0, or a setting is out of its range.
        """
        if not (math.isfinite(scene_scale) and scene_scale > 0):
            raise ValueError(f"scene_scale must be finite and above 0, got {scene_scale}")
        if steps < 1:
            raise ValueError(f"steps must be at least 1, got {steps}")
        if not 0 <= settings.means_decay_from < NOMINAL_STEPS:
            raise ValueError(
                f"means_decay_from must be 0 or more and below {NOMINAL_STEPS}, got"
                f" {settings.means_decay_from}"
            )
        if settings.shN_every < 1:
            raise ValueError(f"shN_every must be at least 1, got {settings.shN_every}")
        self.gaussians = gaussians
        self.means_rate = settings.means * scene_scale
        self.means_final = settings.means_final
        self.means_decay_from = settings.means_decay_from * steps / NOMINAL_STEPS
        self.shN_every = settings.shN_every
        self.steps = steps
        self.steps_done = 0
        self.backend = resolve_backend(backend)
        rates = {name: getattr(settings, name) for name in PARAMETERS}
        rates["means"] = self.means_rate
        rates["shN"] *= self.shN_every
        self.adam = torch.optim.Adam(
            [{"name": name, "params": [gaussians[name]], "lr": rates[name]} for name in PARAMETERS],
            betas=(settings.beta1, settings.beta2),
            eps=settings.eps,
            fused=True,  # a fifth of the default's time, and as exact
        )

    def step(self, camera: Camera | None = None, *, sh_degree: int = 0) -> None:
        """Move every parameter that has a gradient, then decay the rate of `means`.

        With a camera, shN moves too, at every `shN_every`-th step, by the gradient that sh0's
        implies. Seen from one place, a Gaussian has one colour c, which is linear in its harmonics:
        d c / d shN[k] = basis[k](dir) and d c / d sh0 = C0. So the gradient of shN[k] is the
        gradient of sh0 times basis[k](dir) / C0.

        Args:
            camera: The view that the gradients come from, as the Gaussians were rendered in it.
            sh_degree: Highest band of the spherical harmonics that was rendered.
        """
        implementation("optimizer", self.backend).step(
            self.adam, camera if self.moves_harmonics else None, sh_degree
        )
        self.skip_step()

    @property
    def moves_harmonics(self) -> bool:
        """Whether the next step moves shN."""
        return self.steps_done % self.shN_every == 0

    def skip_step(self) -> None:
        """Count a training step and decay the rate of `means`, but move nothing.

        Adam's moments and the number of its steps stay as they are.
        """
        self.steps_done += 1
        self._decay_means_rate()

    def _decay_means_rate(self) -> None:
        decaying = max(0, self.steps_done - self.means_decay_from)
        decay: float = self.means_final ** (decaying / (self.steps - self.means_decay_from))
        self._group("means")["lr"] = self.means_rate * decay

    def rate(self, name: str) -> float:
        """Return the present learning rate of the parameter `name`."""
        rate: float = self._group(name)["lr"]
        return rate

    def zero_grad(self) -> None:
        """Drop the gradients of all parameters."""
        for name in PARAMETERS:
            self.gaussians[name].grad = None

    def state_bytes(self) -> int:
        """Return the number of bytes of Adam's state."""
        return sum(value.nbytes for state in self.adam.state.values() for value in state.values())

    def state_dict(self) -> dict[str, Any]:
        """Return the state that `load_state_dict` continues from.

        Returns:
            `gaussians`: the parameters by name; `adam`: the state of each parameter by name, empty
            where it has none; `steps_done`.
        """
        values = {name: self.gaussians[name].detach() for name in PARAMETERS}
        adam = {name: dict(self.adam.state.get(self.gaussians[name], {})) for name in PARAMETERS}
        return {"gaussians": values, "adam": adam, "steps_done": self.steps_done}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore Gaussians, of any number, moments and learning rates; drop gradients.

        Raises:
            KeyError: A parameter or moment is missing.
            ValueError: A parameter or moment has another shape or type; nothing is changed.
        """
        values, adam = state["gaussians"], state["adam"]
        count = len(values["means"])
        for name in PARAMETERS:
            current = self.gaussians[name]
            moments = [adam[name][key] for key in ("exp_avg", "exp_avg_sq") if adam[name]]
            for value in (values[name], *moments):
                if value.shape != (count, *current.shape[1:]) or value.dtype != current.dtype:
                    raise ValueError(
                        f"{name} must be {current.dtype} {[count, *current.shape[1:]]}, got"
                        f" {value.dtype} {list(value.shape)}"
                    )
            if adam[name] and adam[name]["step"].shape != ():
                raise ValueError(f"{name}: Adam's step must be a scalar")
        for name in PARAMETERS:
            self._replace(name, values[name], torch.zeros_like)
            self.adam.state.pop(self.gaussians[name], None)
            if adam[name]:
                self.adam.state[self.gaussians[name]] = dict(adam[name])
        self.steps_done = int(state["steps_done"])
        self._decay_means_rate()

    def keep(self, index: Tensor) -> None:
        """Remove all other Gaussians, with their moments.

        Args:
            index: The Gaussians to keep: [N] bool, or [M] int64 indices in their new order.
        """
        if index.dtype == torch.bool:
            index = index.nonzero()[:, 0]
        for name in PARAMETERS:
            # `index_select` copies whole rows, in a third of the time of `[index]`.
            values = self.gaussians[name].detach().index_select(0, index)
            self._replace(name, values, lambda moment: moment.index_select(0, index))

    def append(self, new: Mapping[str, Tensor]) -> None:
        """Add Gaussians behind the present ones, with moments of zero.

        Args:
            new: Raw parameters [M, ...] for each name of `PARAMETERS`.
        """
        count = len(new["means"])

        def lengthen(moment: Tensor) -> Tensor:
            return torch.cat([moment, moment.new_zeros(count, *moment.shape[1:])])

        for name in PARAMETERS:
            longer = torch.cat([self.gaussians[name].detach(), new[name]])
            self._replace(name, longer, lengthen)

    def reset(self, name: str, value: Tensor) -> None:
        """Give the parameter `name` new values [N, ...] and moments of zero."""
        self._replace(name, value, torch.zeros_like)

    def forget(self, index: Tensor) -> None:
        """Give the Gaussians `index` [M] moments of zero in every parameter."""
        for name in PARAMETERS:
            state = self.adam.state.get(self.gaussians[name], {})
            for key in state.keys() & {"exp_avg", "exp_avg_sq"}:
                state[key][index] = 0

    def _replace(self, name: str, value: Tensor, moment: Callable[[Tensor], Tensor]) -> None:
        """Replace a parameter by `value`, and each of its Adam moments m by `moment(m)`."""
        state = self.adam.state.pop(self.gaussians[name], {})
        leaf = value.detach().requires_grad_()
        self.gaussians[name] = leaf
        self._group(name)["params"] = [leaf]
        if state:  # none before the first step
            moments = {key: moment(state[key]) for key in ("exp_avg", "exp_avg_sq")}
            self.adam.state[leaf] = state | moments

    def _group(self, name: str) -> dict[str, Any]:
        return self.adam.param_groups[PARAMETERS.index(name)]
