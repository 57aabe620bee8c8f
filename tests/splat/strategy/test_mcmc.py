"""3DGS-MCMC against gsplat's `MCMCStrategy` on the same inputs, and its formulas in float64."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from torch import Tensor

from tests.splat.scenes import make_optimizer, take_step
from tests.splat.strategy.gsplats import SCENE_SCALE, TheirsMCMC, random_values, relocation
from xrgs.splat.gaussians import PARAMETERS
from xrgs.splat.settings import DensifySettings
from xrgs.splat.strategy.base import Refinement
from xrgs.splat.strategy.mcmc import MOST_SHARES, MCMCStrategy, share_out

SETTINGS = DensifySettings(stop=25_000, budget=1.0, noise=5e5)
NOTHING = torch.zeros(0, dtype=torch.bool)


def strategy_of(
    values: dict[str, Tensor],
    settings: DensifySettings = SETTINGS,
    *,
    most: int = 1000,
    seed: int = 0,
    backend: str = "torch",
) -> MCMCStrategy:
    """A strategy that adds Gaussians until there are `most`."""
    return MCMCStrategy(
        make_optimizer(values, scene_scale=SCENE_SCALE, backend=backend),
        settings,
        scene_scale=SCENE_SCALE,
        generator=torch.Generator().manual_seed(seed),
        view_pixels=most,
    )


def after_step(strategy: MCMCStrategy, step: int) -> Refinement:
    return strategy.after_step(step, None, NOTHING, width=40, height=30)


def random_start(count: int, seed: int = 0) -> dict[str, Tensor]:
    """Gaussians of which about a fifth are dead."""
    rng = np.random.default_rng(seed)
    return random_values(count, rng, scales=(np.log(0.003), np.log(0.1)), opacities=(-8, 5))


def assert_same(ours: MCMCStrategy, theirs: TheirsMCMC) -> None:
    for name in PARAMETERS:
        mine, reference = ours.gaussians[name].detach(), theirs.params[name].detach()
        # Theirs go through float32 between the formulas.
        torch.testing.assert_close(mine, reference, rtol=1e-5, atol=1e-5)
        mine_state = ours.optimizer.adam[name]
        for key, value in theirs.optimizers[name].state[theirs.params[name]].items():
            assert torch.equal(mine_state[key], value), (name, key)


@pytest.mark.parametrize(
    ("step", "count", "most"),
    [
        *((step, 100, 1000) for step in (500, 550, 600, 24_900, 25_000)),
        *((600, count, most) for count, most in ((4, 5), (300, 303), (300, 200))),
    ],
)
def test_a_step_is_gsplats(step: int, count: int, most: int) -> None:
    values, gradients = random_start(count, 0), random_start(count, 1)
    ours, theirs = strategy_of(values, most=most), TheirsMCMC(values, SETTINGS, most)
    take_step(ours.optimizer, gradients)
    theirs.descend(gradients)
    dead = int((torch.sigmoid(ours.gaussians.opacities) <= 0.005).sum())
    refinement = after_step(ours, step)
    theirs.densify(step)
    assert_same(ours, theirs)
    refines = step in {600, 24_900}
    added = max(0, min(most, int(1.05 * count)) - count)
    assert refinement == (Refinement(relocated=dead, added=added) if refines else Refinement())
    assert len(ours.gaussians) == count + refinement.added


@pytest.mark.slow
def test_a_run_of_300_steps_is_gsplats() -> None:
    settings = SETTINGS.scaled(300)
    values = random_start(100)
    ours, theirs = strategy_of(values, settings, most=300), TheirsMCMC(values, settings, 300)
    relocated = 0
    for step in range(300):
        gradients = random_start(len(ours.gaussians), step)
        gradients["opacities"] += 3.0  # they fade, and some die
        gradients["scales"] += 4.0  # about as many grow as shrink
        take_step(ours.optimizer, gradients)
        theirs.descend(gradients)
        relocated += after_step(ours, step).relocated
        theirs.densify(step)
        # From the same values again: here steps are compared, not how roundings add up.
        for name in PARAMETERS:
            mine, reference = ours.gaussians[name].data, theirs.params[name].data
            torch.testing.assert_close(mine, reference, rtol=1e-4, atol=1e-4)
            mine.copy_(reference)
    assert len(ours.gaussians) == 300
    assert relocated > 500


@pytest.mark.parametrize("opacity", [1e-6, 0.005, 0.5, 0.999, 1 - 2**-22])
def test_shares_are_those_of_gsplats_kernel(opacity: float) -> None:
    shares = torch.arange(1, MOST_SHARES + 1)
    shared, factors = share_out(torch.full((MOST_SHARES,), opacity).double(), shares)
    exact = [relocation(torch.tensor(opacity).item(), n) for n in shares.tolist()]
    expected = torch.tensor(exact, dtype=torch.float64).T
    torch.testing.assert_close(torch.stack([shared, factors]), expected, rtol=1e-8, atol=0)


def test_many_shares_and_full_opacity_stay_finite() -> None:
    opacities = torch.tensor([1.0, 1.0, 0.0, 0.5], dtype=torch.float64)
    shared, factors = share_out(opacities, torch.tensor([1, 51, 1, 1000]))
    assert (shared[[0, 1, 3]] > 0).all()
    assert (shared < 1).all()
    assert (factors[[0, 1, 3]] > 0).all()
    assert shared[3] == share_out(opacities[3:], torch.tensor([MOST_SHARES]))[0]


def test_noise_is_the_formula_in_float64(backend: str) -> None:
    values = random_start(500, 1)
    strategy = strategy_of(values, backend=backend, seed=3)
    after_step(strategy, 1)
    generator = torch.Generator().manual_seed(3)
    exact = {name: value.double() for name, value in values.items()}
    w, x, y, z = torch.nn.functional.normalize(exact["quats"], dim=-1).unbind(-1)
    # The matrix of v -> q v q*, as two products of quaternions.
    left = torch.stack([w, -x, -y, -z, x, w, -z, y, y, z, w, -x, z, -y, x, w], -1).view(-1, 4, 4)
    right = torch.stack([w, x, y, z, -x, w, -z, y, -y, z, w, -x, -z, -y, x, w], -1).view(-1, 4, 4)
    rotation = (left @ right)[:, 1:, 1:]
    covariance = rotation @ torch.diag_embed(torch.exp(2 * exact["scales"])) @ rotation.mT
    opacity = torch.sigmoid(exact["opacities"])
    size = 5e5 * 1.6e-4 * SCENE_SCALE / (1 + torch.exp(-100 * ((1 - opacity) - 0.995)))
    # Drawn along the axes of those that it moves by more than a rounding.
    moving = torch.sigmoid(100 * (0.005 - opacity)) > 2**-24
    drawn = torch.randn(int(moving.sum()), 3, generator=generator, dtype=torch.float64)
    normal = torch.zeros(500, 3).double()
    normal[moving] = (rotation[moving] @ drawn[:, :, None])[..., 0]
    expected = exact["means"] + size[:, None] * (covariance @ normal[:, :, None])[..., 0]
    torch.testing.assert_close(
        strategy.gaussians.means.detach().double(), expected, rtol=2e-6, atol=2e-6
    )
    assert (strategy.gaussians.means != values["means"]).any(dim=1).sum() > 100


def test_without_noise_nothing_moves_and_nothing_is_drawn() -> None:
    values = random_start(20)
    strategy = strategy_of(values, DensifySettings(budget=1.0))
    before = strategy.generator.get_state()
    assert after_step(strategy, 1) == Refinement()
    assert all(torch.equal(strategy.gaussians[name], values[name]) for name in PARAMETERS)
    assert torch.equal(strategy.generator.get_state(), before)


def test_gaussians_that_are_not_finite_are_removed_before_any_is_drawn() -> None:
    values = random_start(100)
    values["means"][0] = math.nan
    values["opacities"][1] = math.nan
    values["scales"][2] = math.inf
    strategy = strategy_of(values, most=100)
    refinement = after_step(strategy, 600)
    assert (refinement.pruned_non_finite, refinement.added) == (3, 3)
    assert refinement.removed == 3
    assert all(torch.isfinite(strategy.gaussians[name]).all() for name in PARAMETERS)


@pytest.mark.parametrize(
    ("count", "logit", "added"), [(100, -8.0, 5), (100, -200.0, 0), (0, 0.0, 0)]
)
def test_where_nobody_lives_there_is_nobody_to_move_to(
    count: int, logit: float, added: int
) -> None:
    values = random_start(count) | {"opacities": torch.full((count,), logit)}
    assert after_step(strategy_of(values), 600) == Refinement(added=added)


def test_removed_gaussians_leave_the_others_as_they_are() -> None:
    values = random_start(10)
    strategy = strategy_of(values)
    mask = torch.arange(10) % 3 == 0
    assert strategy.remove(mask) == 4
    assert torch.equal(strategy.gaussians.means, values["means"][~mask])


def test_the_defaults_are_gsplats() -> None:
    from gsplat.strategy import MCMCStrategy as Reference

    theirs = Reference()
    assert (theirs.refine_start_iter, theirs.refine_stop_iter) == (SETTINGS.start, SETTINGS.stop)
    assert (theirs.refine_every, theirs.noise_lr) == (SETTINGS.every, SETTINGS.noise)
    assert theirs.min_opacity == SETTINGS.prune_opacity
