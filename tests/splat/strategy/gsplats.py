"""gsplat's `DefaultStrategy` on the inputs of ours: the oracle of densification."""

from __future__ import annotations

from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any
from unittest.mock import patch

import torch
from gsplat.strategy import DefaultStrategy
from gsplat.strategy.ops import reset_opa
from torch import Tensor

from xrgs.splat.gaussians import PARAMETERS
from xrgs.splat.settings import DensifySettings, OptimizerSettings

SCENE_SCALE = 1.7
SIZES = {"HR": (40, 30), "LR": (8, 6)}
"""LR views are five times smaller; gradients in normalised device units do not depend on it."""


@dataclass
class View:
    """The image-plane gradients and visibility of a step."""

    gradient: Tensor  # [N, 2] per px
    visible: Tensor  # [N]
    absgrad: Tensor | None = None  # [N, 2], what gsplat also has of a render with absgrad
    group: str = "HR"


def randn_in_double(*size: int, device: torch.device) -> Tensor:
    """Random numbers for gsplat's split as ours draws them."""
    return torch.normal(torch.zeros(size, dtype=torch.float64, device=device), 1.0).float()


class Theirs:
    """gsplat's strategy with an Adam a parameter, as its trainer has them."""

    def __init__(self, values: dict[str, Tensor], config: DensifySettings, seed: int = 0) -> None:
        self.params = {name: torch.nn.Parameter(value.clone()) for name, value in values.items()}
        rates = OptimizerSettings()
        self.optimizers = {
            name: torch.optim.Adam(
                [self.params[name]],
                lr=getattr(rates, name) * (SCENE_SCALE if name == "means" else 1),
                eps=1e-15,
                fused=True,
            )
            for name in PARAMETERS
        }
        self.strategy = DefaultStrategy(
            prune_opa=config.prune_opacity,
            grow_grad2d=config.grow_grad2d,
            grow_scale3d=config.grow_scale3d,
            prune_scale3d=config.prune_scale3d,
            refine_start_iter=config.start,
            refine_stop_iter=config.stop,
            reset_every=config.reset_every,
            refine_every=config.every,
        )
        self.state = self.strategy.initialize_state(SCENE_SCALE)
        self.resets = config.resets
        # It draws from torch's global generator, whose state is ours between its calls.
        self.random = torch.Generator().manual_seed(seed).get_state()

    def descend(self, gradients: dict[str, Tensor]) -> None:
        for name, optimizer in self.optimizers.items():
            self.params[name].grad = gradients[name].clone()
            optimizer.step()

    def densify(self, step: int, view: View) -> None:
        width, height = SIZES[view.group]
        info: dict[str, Any] = {
            "width": width,
            "height": height,
            "n_cameras": 1,
            "gaussian_ids": None,
            "radii": view.visible[None, :, None].expand(-1, -1, 2).int(),
            "means2d": SimpleNamespace(grad=view.gradient[None]),
        }
        if view.absgrad is not None:
            info["means2d"].absgrad = view.absgrad[None]
        with torch.random.fork_rng(devices=[]), patch("torch.randn", randn_in_double):
            torch.set_rng_state(self.random)
            self.strategy.step_post_backward(self.params, self.optimizers, self.state, step, info)
            self.random = torch.get_rng_state()
        # 1.5.3's own never happens; this is the condition that its pull request 776 restores.
        strategy = self.strategy
        is_due = 0 < step < strategy.refine_stop_iter and step % strategy.reset_every == 0
        if self.resets and is_due:
            value = strategy.prune_opa * 2.0
            reset_opa(self.params, self.optimizers, self.state, value)
