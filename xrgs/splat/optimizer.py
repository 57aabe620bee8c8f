"""Adam over the six parameters of the Gaussians, and its state as Gaussians come and go."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import normalize

from xrgs.splat.backend import resolve_backend
from xrgs.splat.cameras import Camera
from xrgs.splat.gaussians import PARAMETERS, Gaussians
from xrgs.splat.settings import OptimizerSettings
from xrgs.splat.sh import C0, sh_basis


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

    def step(self, camera: Camera | None = None, *, sh_degree: int = 0) -> None:
        """Move every parameter that has a gradient, then decay the rate of `means`.

        With a camera shN moves, too, by the gradient that sh0's implies: seen from one place, all
        harmonics of a Gaussian change one colour, so their gradient is that of the colour times
        the basis in the direction of view, and sh0's has the constant C0 in the basis' place.

        Args:
            camera: The view that the gradients come from, as the Gaussians were rendered in it.
            sh_degree: Highest band that was on.
        """
        if self.native:
            from xrgs.splat.native import optimizer as native_adam

            native_adam.step(self.adam, camera, sh_degree)
        else:
            if camera is not None:
                self._give_harmonics_gradient(camera, sh_degree)
            self.adam.step()
        self.steps_done += 1
        self._decay()

    def _decay(self) -> None:
        decay: float = self.means_final ** (self.steps_done / self.steps)
        self._group("means")["lr"] = self.means_rate * decay

    @torch.no_grad()
    def _give_harmonics_gradient(self, camera: Camera, sh_degree: int) -> None:
        means, sh0, shN = self.gaussians.means, self.gaussians.sh0, self.gaussians.shN
        if sh0.grad is not None:
            dirs = normalize(means - camera.position.to(means), dim=-1)
            basis = sh_basis(sh_degree, dirs)[:, 1:, None]  # [N, K - 1, 1]
            shN.grad = torch.zeros_like(shN)
            shN.grad[:, : basis.shape[1]] = basis * (sh0.grad / C0)

    def zero_grad(self) -> None:
        """Forget the gradients."""
        self.adam.zero_grad()

    def state_bytes(self) -> int:
        """Bytes of Adam's state."""
        return sum(value.nbytes for state in self.adam.state.values() for value in state.values())

    def state_dict(self) -> dict[str, Any]:
        """The Gaussians, Adam's state of each parameter that has one, and the steps done."""
        values = {name: self.gaussians[name].detach() for name in PARAMETERS}
        adam = {name: dict(self.adam.state.get(self.gaussians[name], {})) for name in PARAMETERS}
        return {"gaussians": values, "adam": adam, "steps_done": self.steps_done}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Gaussians, moments and rates as `state_dict` told of them; gradients are forgotten.

        Raises:
            KeyError: A parameter or moment is missing.
            ValueError: One has another shape or type than its place; nothing is changed then.
        """
        values, adam = state["gaussians"], state["adam"]
        count = len(values["means"])
        for name in PARAMETERS:
            here = self.gaussians[name]
            moments = [adam[name][key] for key in ("exp_avg", "exp_avg_sq") if adam[name]]
            for value in (values[name], *moments):
                if value.shape != (count, *here.shape[1:]) or value.dtype != here.dtype:
                    raise ValueError(f"{name}: {value.dtype} {list(value.shape)} does not fit")
            if adam[name] and adam[name]["step"].shape != ():
                raise ValueError(f"{name}: its count of steps is not one number")
        for name in PARAMETERS:
            self._replace(name, values[name], torch.zeros_like)
            self.adam.state.pop(self.gaussians[name], None)
            if adam[name]:
                self.adam.state[self.gaussians[name]] = dict(adam[name])
        self.steps_done = int(state["steps_done"])
        self._decay()

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
