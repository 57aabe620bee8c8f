"""gsplat's strategies on the inputs of ours: the oracles of densification."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from types import SimpleNamespace
from typing import Any
from unittest.mock import patch

import numpy as np
import torch
from gsplat.cuda._torch_impl import _quat_scale_to_covar_preci
from gsplat.strategy import DefaultStrategy, MCMCStrategy
from gsplat.strategy.ops import reset_opa
from gsplat.utils import normalized_quat_to_rotmat
from torch import Tensor

from xrgs.splat.gaussians import PARAMETERS
from xrgs.splat.settings import DensifySettings, OptimizerSettings

SCENE_SCALE = 1.7
SIZES = {"HR": (40, 30), "LR": (8, 6)}
"""LR views are five times smaller; gradients in normalised device units do not depend on it."""


def random_values(
    count: int,
    rng: np.random.Generator,
    *,
    scales: tuple[float, float],
    opacities: tuple[float, float],
) -> dict[str, Tensor]:
    """Raw parameters, the last two uniform between bounds: logarithms of scales, and logits."""
    values = {
        "means": rng.normal(size=(count, 3)),
        "quats": rng.normal(size=(count, 4)),
        "scales": rng.uniform(*scales, size=(count, 3)),
        "opacities": rng.uniform(*opacities, size=count),
        "sh0": rng.normal(size=(count, 1, 3)),
        "shN": rng.normal(size=(count, 3, 3)),
    }
    return {name: torch.from_numpy(value).float() for name, value in values.items()}


@dataclass
class View:
    """The image-plane gradients and visibility of a step."""

    gradient: Tensor  # [N, 2] per px
    visible: Tensor  # [N]
    group: str = "HR"


def randn_in_double(*size: int, device: torch.device) -> Tensor:
    """Random numbers for gsplat's split as ours draws them."""
    return torch.normal(torch.zeros(size, dtype=torch.float64, device=device), 1.0).float()


class Trainer:
    """An Adam a parameter, as gsplat's trainer has them, and the state of torch's generator."""

    def __init__(self, values: dict[str, Tensor], seed: int) -> None:
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
        # gsplat draws from torch's global generator, whose state is ours between its calls.
        self.random = torch.Generator().manual_seed(seed).get_state()

    def descend(self, gradients: dict[str, Tensor]) -> None:
        for name, optimizer in self.optimizers.items():
            self.params[name].grad = gradients[name].clone()
            optimizer.step()

    @contextmanager
    def drawing(self) -> Iterator[None]:
        """Let torch's global generator draw the numbers of `random`."""
        with torch.random.fork_rng(devices=[]):
            torch.set_rng_state(self.random)
            yield
            self.random = torch.get_rng_state()


class Theirs(Trainer):
    """gsplat's default strategy."""

    def __init__(self, values: dict[str, Tensor], config: DensifySettings, seed: int = 0) -> None:
        super().__init__(values, seed)
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
        with self.drawing(), patch("torch.randn", randn_in_double):
            self.strategy.step_post_backward(self.params, self.optimizers, self.state, step, info)
        # 1.5.3's own never happens; this is the condition that its pull request 776 restores.
        strategy = self.strategy
        is_due = 0 < step < strategy.refine_stop_iter and step % strategy.reset_every == 0
        if self.resets and is_due:
            value = strategy.prune_opa * 2.0
            reset_opa(self.params, self.optimizers, self.state, value)


@cache
def _coefficients(shares: int) -> list[float]:
    """The coefficient of each power of the opacity in the sum over i and k of the kernel."""
    sums = [sum(math.comb(i - 1, k) for i in range(k + 1, shares + 1)) for k in range(shares)]
    return [(-1) ** k * each / math.sqrt(k + 1) for k, each in enumerate(sums)]


def relocation(opacity: float, shares: int) -> tuple[float, float]:
    """gsplat's kernel of relocation (`cuda/csrc/RelocationCUDA.cu`) in double, which needs a GPU.

    Returns:
        The opacity of each of the Gaussians, and the factor of their scales.
    """
    shared = 1 - (1 - opacity) ** (1 / shares)
    terms = (c * shared ** (k + 1) for k, c in enumerate(_coefficients(shares)))
    return shared, opacity / math.fsum(terms)


class TheirsMCMC(Trainer):
    """gsplat's MCMC strategy, with kernels in torch, which draws as ours does."""

    def __init__(
        self, values: dict[str, Tensor], config: DensifySettings, most: int, seed: int = 0
    ) -> None:
        super().__init__(values, seed)
        self.strategy = MCMCStrategy(
            cap_max=most,
            noise_lr=config.noise,
            refine_start_iter=config.start,
            refine_stop_iter=config.stop,
            refine_every=config.every,
            min_opacity=config.prune_opacity,
        )
        self.state = self.strategy.initialize_state()

    def densify(self, step: int) -> None:
        rate = self.optimizers["means"].param_groups[0]["lr"]
        with (
            self.drawing(),
            patch("gsplat.strategy.ops.compute_relocation", _compute_relocation),
            patch("gsplat.strategy.ops.quat_scale_to_covar_preci", _quat_scale_to_covar_preci),
            patch("gsplat.strategy.ops._multinomial_sample", _draw_in_double),
            patch("torch.randn_like", self._noise),
        ):
            self.strategy.step_post_backward(
                self.params, self.optimizers, self.state, step, {}, lr=rate
            )

    def _noise(self, means: Tensor) -> Tensor:
        """As ours: only where it matters, and drawn along the axes of the Gaussians."""
        exponents = -100 * ((1 - torch.sigmoid(self.params["opacities"])) - 0.995)
        moving = 1 / (1 + torch.exp(exponents)) > 2**-24
        noise = torch.zeros_like(means)
        drawn = randn_in_double(int(moving.sum()), 3, device=means.device)
        quats = torch.nn.functional.normalize(self.params["quats"][moving], dim=-1)
        noise[moving] = torch.einsum("nij,nj->ni", normalized_quat_to_rotmat(quats), drawn)
        return noise


def _compute_relocation(
    opacities: Tensor, scales: Tensor, ratios: Tensor, binoms: Tensor
) -> tuple[Tensor, Tensor]:
    shares = ratios.clamp(min=1, max=len(binoms)).tolist()
    made = [relocation(*pair) for pair in zip(opacities.tolist(), shares, strict=True)]
    shared, factors = torch.tensor(made, dtype=torch.float64).T
    return shared.float(), (factors[:, None] * scales).float()


def _draw_in_double(weights: Tensor, n: int, replacement: bool) -> Tensor:
    return torch.multinomial(weights.double(), n, replacement=replacement)
