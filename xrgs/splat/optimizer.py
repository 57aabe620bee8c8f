"""Adam for the six parameters of the Gaussians; its state follows added and removed Gaussians."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import torch
from torch import Tensor

from xrgs.splat.backend import implementation, resolve_backend
from xrgs.splat.cameras import Camera
from xrgs.splat.gaussians import PARAMETERS, Gaussians
from xrgs.splat.settings import NOMINAL_STEPS, OptimizerSettings, outside_limits

_MOMENTS = ("exp_avg", "exp_avg_sq")
LENGTH_GROUPS = ("scales", "quats", "sh0", "shN")
"""The parameters whose rates `length_power` scales by the length of the run. Not `means`, which
have their own schedule, nor `opacities`: gsplat's rate of 0.05 moves logits far enough."""


class SplatOptimizer:
    """Adam with a learning rate for each parameter, gsplat's by default.

    The rates are from gsplat's `examples/simple_trainer.py`. The rate of `means` after t steps is

        rate(t) = means * scene_scale * means_final^(max(0, t - t0) / (steps - t0))

    where t0 is `means_decay_from * steps / 30,000`, 0 in gsplat. DashGaussian [chen2025dash] starts
    the decay later, after its steps at a reduced resolution.

    gsplat's rates are meant for 30,000 steps. With `length_power` of p, the rates of scales, quats,
    sh0 and shN in a run of T steps, T below 30,000, are (docs/training.md has the reasons)

        rate(t) = rate * (30,000 / T)^(p * min(1, (T - t) / (T - t1)))

    where t1 is `length_decay_from * T / 30,000`: constant up to t1, then falling exponentially to
    gsplat's rates after the last step. In longer runs they are gsplat's. Our choice: reports/rates
    compares powers.

    With `shN_every` of k, shN and its moments are updated only at every k-th step, starting with
    the first, by the gradient of that step and at k times the rate. Our choice, to save the
    gradients of the other steps. Adam's steps do not depend on the gradient's size: a coefficient
    with a gradient of constant sign moves as far as with k = 1.

    Gaussians are added and removed only through `append` and `keep`, so that parameters and state
    always fit. New Gaussians start with moments of zero and the step count of the others, as in
    gsplat (`strategy/ops.py`).

    `torch.optim.Adam` gives the same, but its first use in a process imports torch's compiler,
    which takes more than a second.

    Attributes:
        adam: Parameter name -> its Adam state with torch's names: `step` [], `exp_avg` and
            `exp_avg_sq` [N, ...]; empty before the parameter's first step.
        backend: `torch`, `native` or `gsplat`: the backend that computes a step.
        gaussians: The optimized Gaussians.
        rates: Parameter name -> learning rate of the next step.
        settings: Learning rates at the start, and Adam's constants.
        steps_done: Number of training steps so far, including those of `skip_step`.
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
        """Start without Adam state.

        Args:
            gaussians: The Gaussians to optimize. Adding or removing some replaces their tensors.
            settings: Learning rates and Adam's constants.
            scene_scale: Extent of the scene in world units, above 0.
            steps: Number of steps of the whole run, at least 1.
            backend: Backend that computes the steps (`resolve_backend`).

        Raises:
            ValueError: `scene_scale` or `steps` is not above 0, or a setting is out of its range.
        """
        if not (math.isfinite(scene_scale) and scene_scale > 0):
            raise ValueError(f"scene_scale must be finite and above 0, got {scene_scale}")
        if steps < 1:
            raise ValueError(f"steps must be at least 1, got {steps}")
        for message in outside_limits(settings):
            raise ValueError(message)
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
        """Update every parameter that has a gradient, then set the rates of the next step.

        With a camera, shN is updated too, at every `shN_every`-th step; its gradient follows from
        that of sh0. Seen from one camera, a Gaussian has one colour c, linear in its harmonics:
        d c / d shN[k] = basis[k](dir) and d c / d sh0 = C0. So the gradient of shN[k] is the
        gradient of sh0 times basis[k](dir) / C0.

        Args:
            camera: The rendered view that the gradients come from. None leaves shN as it is, unless
                shN has a gradient.
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
        """Whether the next step updates shN."""
        return self.steps_done % self.settings.shN_every == 0

    def skip_step(self) -> None:
        """Count a training step and set the next rates, without an update.

        Adam's moments and step counts stay as they are.
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
        """Return the size of Adam's state, bytes."""
        return sum(value.nbytes for state in self.adam.values() for value in state.values())

    def state_dict(self) -> dict[str, Any]:
        """Return the state for a checkpoint: `gaussians` and `adam` by name, and `steps_done`."""
        values = {name: self.gaussians[name].detach() for name in PARAMETERS}
        adam = {name: dict(self.adam[name]) for name in PARAMETERS}
        return {"gaussians": values, "adam": adam, "steps_done": self.steps_done}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore any number of Gaussians, moments and learning rates; drop gradients.

        Raises:
            KeyError: A parameter or moment is missing.
            ValueError: A parameter or moment has the wrong shape or type. Nothing is changed then.
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
        """Keep only the Gaussians of `index`: [N] bool, or [M] int64 in their new order."""
        if index.dtype == torch.bool:
            index = index.nonzero()[:, 0]
        for name in PARAMETERS:
            # `index_select` copies whole rows: it takes a third of the time of `[index]`.
            values = self.gaussians[name].detach().index_select(0, index)
            self._replace(name, values, lambda moment: moment.index_select(0, index))

    def append(self, new: Mapping[str, Tensor]) -> None:
        """Append Gaussians by their raw parameters [M, ...], with moments of zero."""
        count = len(new["means"])

        def lengthen(moment: Tensor) -> Tensor:
            return torch.cat([moment, moment.new_zeros(count, *moment.shape[1:])])

        for name in PARAMETERS:
            longer = torch.cat([self.gaussians[name].detach(), new[name]])
            self._replace(name, longer, lengthen)

    def reset(self, name: str, value: Tensor) -> None:
        """Set the values [N, ...] of the parameter `name`, and its moments to zero."""
        self._replace(name, value, torch.zeros_like)

    def forget(self, index: Tensor) -> None:
        """Set all moments of the Gaussians `index` [M] to zero."""
        for name in PARAMETERS:
            for key in self.adam[name].keys() & _MOMENTS:
                self.adam[name][key][index] = 0

    def _replace(self, name: str, value: Tensor, moment: Callable[[Tensor], Tensor]) -> None:
        """Replace a parameter by `value`, and each of its Adam moments m by `moment(m)`."""
        self.gaussians[name] = value.detach().requires_grad_()
        for key in self.adam[name].keys() & _MOMENTS:  # none before the first step
            self.adam[name][key] = moment(self.adam[name][key])
