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

_MOMENTS = ("exp_avg", "exp_avg_sq")
LENGTH_GROUPS = ("scales", "quats", "sh0", "shN")
"""The parameters whose rates `length_power` fits to the length of a run. Means have a schedule of
their own, and a logit opacity moves far enough at gsplat's rate of 0.05."""


class SplatOptimizer:
    """Adam with a learning rate for each parameter, gsplat's by default.

    The rates are from gsplat's `examples/simple_trainer.py`. The rate of `means` after t steps is

        rate(t) = means * scene_scale * means_final^(max(0, t - t0) / (steps - t0))

    where t0 is `means_decay_from * steps / 30,000`, 0 in gsplat. DashGaussian [chen2025dash] lets
    the decay wait while it trains at a reduced resolution.

    gsplat's rates are meant for 30,000 steps. Adam moves a log scale by about its rate at each
    step, so that 600 steps at 0.005 change a scale by at most a factor of e^3, and the first
    scales, the spacing of the SfM points, are often ten times too large. With `length_power` of p,
    the rates of scales, quats, sh0 and shN in a run of T steps, T below 30,000, are

        rate(t) = rate * (30,000 / T)^(p * min(1, (T - t) / (T - t1)))

    where t1 is `length_decay_from * T / 30,000`: larger up to t1, then falling exponentially to
    gsplat's own after the last step, so that the noise of large steps settles. From 30,000 steps
    on the factor is one. Our choice: a random walk of T steps gets as far as rate * sqrt(T), which
    p = 0.5 keeps. reports/rates compares powers.

    With `shN_every` of k, the harmonics above band 0 move at every k-th step alone, the first one
    included, by the gradient of that step, and at k times their rate. Their moments are updated at
    these steps alone. Our choice: the gradients of the other steps are never computed, and the rate
    has the factor k. Adam's steps do not depend on the size of the gradient, so that a coefficient
    with a gradient of constant sign goes as far as with k = 1.

    Gaussians are added and removed through `append` and `keep` alone, so that parameters and state
    always fit. New Gaussians start with moments of zero and the step count of the others, as in
    gsplat (`strategy/ops.py`).

    `torch.optim.Adam` gives the same, but the first one of a process imports torch's compiler,
    which takes more than a second of a cell.

    Attributes:
        adam: Adam's state of each parameter by the names of torch: `step` [], `exp_avg` and
            `exp_avg_sq` [N, ...]; empty before the parameter's first step.
        backend: `torch`, `native` or `gsplat`: the backend that computes a step.
        gaussians: The optimized Gaussians.
        rates: The present learning rate of each parameter.
        settings: Learning rates at the start, and Adam's constants.
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
            backend: `torch`, `native`, `gsplat` or `auto` (`resolve_backend`), which computes the
                steps.

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
        if not 0 <= settings.length_decay_from < NOMINAL_STEPS:
            raise ValueError(
                f"length_decay_from must be 0 or more and below {NOMINAL_STEPS}, got"
                f" {settings.length_decay_from}"
            )
        if not 0 <= settings.length_power <= 1:
            raise ValueError(f"length_power must be 0 to 1, got {settings.length_power}")
        if settings.shN_every < 1:
            raise ValueError(f"shN_every must be at least 1, got {settings.shN_every}")
        self.gaussians = gaussians
        self.settings = settings
        self.means_rate = settings.means * scene_scale
        self.means_decay_from = settings.means_decay_from * steps / NOMINAL_STEPS
        self.length_factor = max(1.0, NOMINAL_STEPS / steps)
        self.length_decay_from = settings.length_decay_from * steps / NOMINAL_STEPS
        self.steps = steps
        self.steps_done = 0
        self.backend = resolve_backend(backend)
        self.rates: dict[str, float] = {name: getattr(settings, name) for name in PARAMETERS}
        self._set_rates()
        self.adam: dict[str, dict[str, Tensor]] = {name: {} for name in PARAMETERS}

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
            self, camera if self.moves_harmonics else None, sh_degree
        )
        self.skip_step()

    def adam_of(self, name: str) -> tuple[Tensor, Tensor, Tensor]:
        """Return exp_avg, exp_avg_sq and step of a parameter, zeros before its first step."""
        state = self.adam[name]
        if not state:
            state["step"] = torch.zeros((), device=self.gaussians[name].device)
            for key in _MOMENTS:
                state[key] = torch.zeros_like(self.gaussians[name], requires_grad=False)
        return state["exp_avg"], state["exp_avg_sq"], state["step"]

    @property
    def moves_harmonics(self) -> bool:
        """Whether the next step moves shN."""
        return self.steps_done % self.settings.shN_every == 0

    def skip_step(self) -> None:
        """Count a training step and decay the rate of `means`, but move nothing.

        Adam's moments and the number of its steps stay as they are.
        """
        self.steps_done += 1
        self._set_rates()

    def _set_rates(self) -> None:
        """Set the rates of the next step."""
        settings, left = self.settings, self.steps - self.steps_done
        decaying = max(0, self.steps_done - self.means_decay_from)
        decay = settings.means_final ** (decaying / (self.steps - self.means_decay_from))
        self.rates["means"] = self.means_rate * decay
        share_left = min(1.0, left / (self.steps - self.length_decay_from))
        factor = self.length_factor ** (settings.length_power * share_left)
        for name in LENGTH_GROUPS:
            self.rates[name] = getattr(settings, name) * factor
        self.rates["shN"] *= settings.shN_every

    def zero_grad(self) -> None:
        """Drop the gradients of all parameters."""
        for name in PARAMETERS:
            self.gaussians[name].grad = None

    def state_bytes(self) -> int:
        """Return the number of bytes of Adam's state."""
        return sum(value.nbytes for state in self.adam.values() for value in state.values())

    def state_dict(self) -> dict[str, Any]:
        """Return the state that `load_state_dict` continues from.

        Returns:
            `gaussians`: the parameters by name; `adam`: the state of each parameter by name, empty
            where it has none; `steps_done`.
        """
        values = {name: self.gaussians[name].detach() for name in PARAMETERS}
        adam = {name: dict(self.adam[name]) for name in PARAMETERS}
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
            moments = [adam[name][key] for key in _MOMENTS if adam[name]]
            for value in (values[name], *moments):
                if value.shape != (count, *current.shape[1:]) or value.dtype != current.dtype:
                    raise ValueError(
                        f"{name} must be {current.dtype} {[count, *current.shape[1:]]}, got"
                        f" {value.dtype} {list(value.shape)}"
                    )
            if adam[name] and adam[name]["step"].shape != ():
                raise ValueError(f"{name}: Adam's step must be a scalar")
        for name in PARAMETERS:
            device = self.gaussians[name].device
            self.gaussians[name] = values[name].detach().to(device).requires_grad_()
            self.adam[name] = {key: moment.to(device) for key, moment in adam[name].items()}
        self.steps_done = int(state["steps_done"])
        self._set_rates()

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
            for key in self.adam[name].keys() & _MOMENTS:
                self.adam[name][key][index] = 0

    def _replace(self, name: str, value: Tensor, moment: Callable[[Tensor], Tensor]) -> None:
        """Replace a parameter by `value`, and each of its Adam moments m by `moment(m)`."""
        self.gaussians[name] = value.detach().requires_grad_()
        for key in self.adam[name].keys() & _MOMENTS:  # none before the first step
            self.adam[name][key] = moment(self.adam[name][key])
