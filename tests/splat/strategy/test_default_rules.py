"""The rules of densification one by one, each at and around its threshold."""

from __future__ import annotations

import math
from functools import partial

import pytest
import torch
from torch import Tensor

from tests.splat.scenes import make_strategy, take_step
from tests.splat.strategy.gsplats import SCENE_SCALE, SIZES, View
from xrgs.splat.gaussians import PARAMETERS
from xrgs.splat.settings import DensifySettings
from xrgs.splat.strategy.base import Groups, Refinement, StrategyHooks, Thresholds
from xrgs.splat.strategy.default import DefaultStrategy

WIDTH, HEIGHT = SIZES["HR"]
NO_HOOKS = StrategyHooks()
strategy_of = partial(make_strategy, scene_scale=SCENE_SCALE)


def uniform(count: int, *, opacity: float = 0.5) -> dict[str, Tensor]:
    """Gaussians at random places, of the scale 0.01 and one opacity."""
    generator = torch.Generator().manual_seed(0)
    return {
        "means": torch.randn(count, 3, generator=generator),
        "quats": torch.randn(count, 4, generator=generator),
        "scales": torch.full((count, 3), math.log(0.01)),
        "opacities": torch.logit(torch.full((count,), opacity)),
        "sh0": torch.randn(count, 1, 3, generator=generator),
        "shN": torch.randn(count, 3, 3, generator=generator),
    }


def view_of(count: int, norm: float = 0.0) -> View:
    """Every Gaussian visible, with a gradient of this norm in normalised device units."""
    gradient = torch.zeros(count, 2)
    gradient[:, 0] = norm / (WIDTH / 2)
    return View(gradient, torch.ones(count, dtype=torch.bool))


def densify(
    strategy: DefaultStrategy,
    step: int,
    view: View,
    hooks: StrategyHooks = NO_HOOKS,
) -> Refinement:
    return strategy.after_step(
        step, view.gradient, view.visible, width=WIDTH, height=HEIGHT, hooks=hooks
    )


def test_each_rule_is_counted_once() -> None:
    values = uniform(5)
    values["opacities"][:2] = -8.0
    values["scales"][1:3] = 0.0  # 1, above 0.1 scene scales; the second is transparent too
    values["means"][3, 1] = torch.nan
    early, late = (strategy_of(values) for _ in range(2))
    assert densify(early, 600, view_of(5)) == Refinement(pruned_non_finite=1, pruned_opacity=2)
    refinement = densify(late, 3100, view_of(5))
    assert refinement == Refinement(pruned_non_finite=1, pruned_opacity=2, pruned_scale=1)
    assert torch.equal(late.gaussians.means.detach(), values["means"][4:])


@pytest.mark.parametrize("name", PARAMETERS)
@pytest.mark.parametrize("value", [torch.nan, torch.inf])
def test_what_is_not_finite_is_dropped_and_leaves_no_copies(name: str, value: float) -> None:
    values = uniform(4)
    values[name][2].fill_(value)
    strategy = strategy_of(values)
    refinement = densify(strategy, 600, view_of(4, norm=1.0))
    assert refinement == Refinement(pruned_non_finite=1, duplicated=3)
    assert all(strategy.gaussians[parameter].isfinite().all() for parameter in PARAMETERS)


def test_a_scale_that_overflows_is_dropped() -> None:
    values = uniform(4)
    values["scales"][1, 2] = 89.0  # finite, and exp of it isn't
    assert densify(strategy_of(values), 600, view_of(4)) == Refinement(pruned_non_finite=1)


def test_without_gaussians_nothing_happens() -> None:
    strategy = strategy_of(uniform(4, opacity=0.001))
    take_step(strategy.optimizer, uniform(4))
    assert densify(strategy, 600, view_of(4)) == Refinement(pruned_opacity=4)
    assert len(strategy.gaussians) == 0
    for step in (601, 700, 3000, 3100):
        take_step(strategy.optimizer, uniform(0))
        assert densify(strategy, step, view_of(0)) == Refinement()
    assert [strategy.gaussians[name].shape[0] for name in PARAMETERS] == [0] * 6


def test_a_nan_gradient_grows_nothing() -> None:
    strategy = strategy_of(uniform(2))
    view = view_of(2, norm=1.0)
    view.gradient[0] = torch.nan
    assert densify(strategy, 600, view).duplicated == 1
    assert strategy.grad2d_sum.isfinite().all()


def test_a_view_that_depends_on_no_gaussian_adds_nothing() -> None:
    strategy = strategy_of(uniform(2))
    densify(strategy, 599, view_of(2, norm=1.0))
    nothing = torch.zeros(2, dtype=torch.bool)
    refinement = strategy.after_step(600, None, nothing, width=WIDTH, height=HEIGHT)
    assert refinement == Refinement(duplicated=2)


# --- what others decide -------------------------------------------------------------------------


def test_hooks_restrict_what_grows() -> None:
    """They are asked when what is not finite has been dropped."""
    values = uniform(4)
    values["means"][1, 0] = torch.nan
    strategy, view = strategy_of(values), view_of(4, norm=1.0)
    hooks = StrategyHooks(may_grow=lambda _: torch.tensor([False, False, True]))
    assert densify(strategy, 599, view, hooks) == Refinement()
    assert densify(strategy, 600, view, hooks) == Refinement(pruned_non_finite=1, duplicated=1)
    assert torch.equal(strategy.gaussians.means[3].detach(), values["means"][3])


def test_removing_keeps_moments_and_statistics_in_step() -> None:
    values = uniform(3)
    strategy = strategy_of(values)
    take_step(strategy.optimizer, {name: value + 1 for name, value in values.items()})
    moments = strategy.optimizer.adam["means"]["exp_avg"].clone()
    densify(strategy, 1, View(torch.eye(3)[:, :2], torch.tensor([True, True, False])))
    sums, counts = strategy.grad2d_sum.clone(), strategy.visible_count.clone()
    assert strategy.remove(torch.tensor([False, True, False])) == 1
    kept = torch.tensor([0, 2])
    state = strategy.optimizer.adam["means"]
    assert torch.equal(state["exp_avg"], moments[kept])
    assert torch.equal(strategy.grad2d_sum, sums[:, kept])
    assert torch.equal(strategy.visible_count, counts[:, kept])
    assert counts.tolist() == [[1, 1, 0]]


# --- exactly at a threshold ---------------------------------------------------------------------


def test_a_gradient_of_exactly_the_threshold_does_not_grow() -> None:
    view = view_of(3, norm=0.5)
    view.gradient[1] *= 1 + 2**-20
    view.gradient[2] *= 1 - 2**-20
    strategy = strategy_of(uniform(3), DensifySettings(grow_grad2d=0.5))
    assert densify(strategy, 600, view) == Refinement(duplicated=1)
    assert torch.equal(strategy.gaussians.means[3], strategy.gaussians.means[1])


@pytest.mark.parametrize(
    ("name", "settings", "step", "expected"),
    [
        # exp(0) is exactly 1, and so is 0.5 times the scene's scale of 2.
        ("scales", DensifySettings(grow_scale3d=0.5), 600, Refinement(duplicated=2, split=1)),
        ("scales", DensifySettings(prune_scale3d=0.5), 3100, Refinement(pruned_scale=1)),
        # The logistic function of 0 is exactly 1/2.
        ("opacities", DensifySettings(prune_opacity=0.5), 600, Refinement(pruned_opacity=1)),
    ],
)
def test_what_is_exactly_at_a_threshold_counts_as_small_and_opaque(
    name: str, settings: DensifySettings, step: int, expected: Refinement
) -> None:
    values = uniform(3)
    signs = torch.tensor([0.0, 1.0, -1.0]) * 1e-6
    values[name] = signs if name == "opacities" else signs[:, None].expand(3, 3)
    strategy = make_strategy(values, settings, scene_scale=2.0)
    view = view_of(3, norm=1.0 if expected.duplicated else 0.0)
    assert densify(strategy, step, view) == expected


def test_opacities_at_the_cap_are_not_counted_as_reset() -> None:
    values = uniform(3)
    values["opacities"][0] = -5.5  # below the cap of 0.01
    strategy = strategy_of(values, DensifySettings(start=20_000))
    assert densify(strategy, 3000, view_of(3)) == Refinement(reset=2)
    assert densify(strategy, 6000, view_of(3)) == Refinement()


def test_the_group_of_a_gaussian_without_gradients_is_the_last() -> None:
    """A gradient of exactly 0 is none: the second group's higher threshold prunes."""
    thresholds = {"HR": Thresholds(1.0, 0.1), "LR": Thresholds(1.0, 0.9)}
    strategy = strategy_of(uniform(2), groups=Groups(thresholds, "per_class"))
    view = view_of(2)
    view.gradient[0] = 1e-3
    refinement = strategy.after_step(
        600, view.gradient, view.visible, width=WIDTH, height=HEIGHT, group="HR"
    )
    assert refinement.by_group["pruned_opacity_HR"] == 0
    assert refinement.by_group["pruned_opacity_LR"] == 1


# --- state --------------------------------------------------------------------------------------
