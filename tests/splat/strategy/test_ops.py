"""Splits along the longest axis in float64, and which Gaussians a budget lets grow."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from tests.splat.scenes import make_strategy
from tests.splat.strategy.gsplats import random_values
from xrgs.splat.gaussians import PARAMETERS, Gaussians
from xrgs.splat.settings import DensifySettings
from xrgs.splat.strategy.base import Refinement, StrategyHooks
from xrgs.splat.strategy.default import DefaultStrategy
from xrgs.splat.strategy.ops import Budget, split_along_longest_axis, top_k

SIDE = 20


def opaque(count: int) -> dict[str, Tensor]:
    """Opaque Gaussians of scales on both sides of gsplat's limit between copies and splits."""
    rng = np.random.default_rng(0)
    return random_values(count, rng, scales=(-7, -3), opacities=(-2, 4))


def refine(
    strategy: DefaultStrategy, step: int, norms: list[float], hooks: StrategyHooks | None = None
) -> Refinement:
    """Refine after one view in which all Gaussians have gradients of these norms."""
    gradient = torch.zeros(len(norms), 2)
    gradient[:, 1] = torch.tensor(norms) / (SIDE / 2)
    visible = torch.ones(len(norms), dtype=torch.bool)
    return strategy.after_step(
        step, gradient, visible, width=SIDE, height=SIDE, hooks=hooks or StrategyHooks()
    )


def rotation(quaternion: np.ndarray) -> np.ndarray:
    """Rodrigues' formula for the axis and angle of a quaternion (w, x, y, z), in float64."""
    w, *xyz = quaternion / np.linalg.norm(quaternion)
    angle, axis = 2 * np.arctan2(np.linalg.norm(xyz), w), np.array(xyz) / np.linalg.norm(xyz)
    cross = np.cross(np.eye(3), axis)  # times a vector v: axis x v
    turned: np.ndarray = np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
    return turned


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_the_halves_of_a_long_axis_split(dtype: torch.dtype) -> None:
    old = {name: value.to(dtype) for name, value in opaque(7).items()}
    new = split_along_longest_axis(old, old["scales"].exp())
    tolerance = 1e-12 if dtype == torch.float64 else 2e-6
    for row in range(7):
        scales = np.exp(old["scales"][row].double().numpy())
        k = int(np.argmax(scales))
        offset = 0.5 * scales[k] * rotation(old["quats"][row].double().numpy())[:, k]
        opacity = 1 / (1 + math.exp(-old["opacities"][row].item()))
        shrunk = scales * np.where(np.arange(3) == k, 0.5, 0.85)
        for half, sign in ((row, 1), (row + 7, -1)):
            mean = old["means"][row].double().numpy() + sign * offset
            logit = math.log(0.6 * opacity / (1 - 0.6 * opacity))
            np.testing.assert_allclose(new["means"][half].double(), mean, atol=tolerance)
            np.testing.assert_allclose(new["scales"][half].double().exp(), shrunk, rtol=tolerance)
            assert new["opacities"][half].item() == pytest.approx(logit, abs=tolerance)
            for name in ("quats", "sh0", "shN"):
                assert torch.equal(new[name][half], old[name][row])
    assert {value.dtype for value in new.values()} == {dtype}


def test_of_equal_scales_the_first_is_the_longest() -> None:
    values = opaque(1)
    values["quats"] = torch.tensor([[1.0, 0, 0, 0]])
    values["scales"] = torch.zeros(1, 3)
    new = split_along_longest_axis(values, torch.ones(1, 3))
    offsets = torch.tensor([[0.5, 0, 0], [-0.5, 0, 0]])
    torch.testing.assert_close(new["means"] - values["means"], offsets)
    torch.testing.assert_close(new["scales"].exp(), torch.tensor([[0.5, 0.85, 0.85]] * 2))


@pytest.mark.parametrize("opacity", [-100.0, 100.0])
def test_an_extreme_opacity_stays_finite(opacity: float) -> None:
    values = opaque(1) | {"opacities": torch.tensor([opacity])}
    logits = split_along_longest_axis(values, values["scales"].exp())["opacities"]
    expected = opacity + math.log(0.6) if opacity < 0 else math.log(0.6 / 0.4)
    torch.testing.assert_close(logits, torch.full((2,), expected))


def test_all_that_grow_are_split_and_no_random_number_is_drawn() -> None:
    values = opaque(6)
    strategy = make_strategy(values, DensifySettings(split="long_axis"))
    state = strategy.generator.get_state()
    assert refine(strategy, 600, [1.0, 0, 1, 0, 1, 1]) == Refinement(split=4)
    assert torch.equal(strategy.generator.get_state(), state)
    grown = {name: value[[0, 2, 4, 5]] for name, value in values.items()}
    halves = split_along_longest_axis(grown, grown["scales"].exp())
    for name in PARAMETERS:
        assert torch.equal(strategy.gaussians[name][:2].detach(), values[name][[1, 3]])
        torch.testing.assert_close(strategy.gaussians[name][2:].detach(), halves[name])


# --- the budget ---------------------------------------------------------------------------------


def test_the_cap_rises_to_the_budget_as_the_root_of_the_progress() -> None:
    shares = (0.0, 0.01, 0.25, 0.81, 1.0)
    assert [Budget(100, 500).cap(share) for share in shares] == [100, 140, 300, 460, 500]
    assert {Budget(700, 500).cap(share) for share in shares} == {500}


@given(
    candidates=st.lists(st.booleans(), min_size=1, max_size=20),
    count=st.integers(0, 25),
    data=st.data(),
)
def test_the_best_are_those_of_a_sorted_list(
    candidates: list[bool], count: int, data: st.DataObject
) -> None:
    score = st.sampled_from([0.0, 1.0, 2.0, 2.5, math.nan, math.inf, -math.inf])
    scores = data.draw(st.lists(score, min_size=len(candidates), max_size=len(candidates)))
    ranked = sorted(
        (index for index, candidate in enumerate(candidates) if candidate),
        key=lambda index: -scores[index] if math.isfinite(scores[index]) else 0.0,
    )
    chosen = top_k(torch.tensor(candidates), torch.tensor(scores), count)
    assert chosen.nonzero()[:, 0].tolist() == sorted(ranked[:count])


def strategy_within(budget: float) -> DefaultStrategy:
    """A budget for each of 400 pixels, with refinements at steps 600, 700, 800 and 900."""
    schedule = DensifySettings(stop=1000, budget=budget, split="long_axis")
    return make_strategy(opaque(8), schedule, view_pixels=SIDE * SIDE)


@pytest.mark.parametrize(
    ("scores", "growing"), [(None, [1, 5]), ([4.0, 1, 9, 3, 9, 2, 9, 9], [0, 3])]
)
def test_the_best_candidates_grow_within_the_budget(
    scores: list[float] | None, growing: list[int]
) -> None:
    """By their gradients, or by scores in their place."""
    strategy = strategy_within(budget=12 / 400)
    before = strategy.gaussians.sh0.detach().clone()
    # A quarter of densification has passed: there may be 8 + 4 / 2, so two of the four grow.
    norms = [3e-4, 9e-4, 0.0, 5e-4, 1e-5, 7e-4, 0.0, 0.0]
    hooks = StrategyHooks(growth_scores=lambda _: None if scores is None else torch.tensor(scores))
    assert refine(strategy, 600, norms, hooks) == Refinement(split=2)
    assert torch.equal(strategy.gaussians.sh0[6:8].detach(), before[growing])


def test_gaussians_that_are_not_finite_are_dropped_before_scores_are_asked_for() -> None:
    strategy = strategy_within(budget=8 / 400)
    strategy.gaussians.means.data[0] = torch.nan
    before = strategy.gaussians.sh0.detach().clone()

    def scores(gaussians: Gaussians) -> torch.Tensor:
        assert gaussians.means.isfinite().all()  # what is rendered for the scores has to be
        return torch.tensor([0.0, 1, 2, 3, 4, 6, 5])

    hooks = StrategyHooks(growth_scores=scores)
    assert refine(strategy, 600, [1.0] * 8, hooks) == Refinement(pruned_non_finite=1, split=1)
    assert torch.equal(strategy.gaussians.sh0[-1].detach(), before[6])


def test_scores_are_asked_for_where_they_decide() -> None:
    asked = []
    hooks = StrategyHooks(growth_scores=lambda gaussians: asked.append(len(gaussians)))
    for budget, norms in ((0.0, [1.0] * 8), (1.0, [1.0] * 8), (12 / 400, [0.0] * 8)):
        refine(strategy_within(budget), 600, norms, hooks)
    refine(strategy_within(4 / 400), 600, [1.0] * 8, hooks)  # there is no room
    assert asked == []
    refine(strategy_within(12 / 400), 600, [1.0] * 8, hooks)
    assert asked == [8]


def test_pruning_makes_room_for_the_next_refinement() -> None:
    strategy = strategy_within(budget=24 / 400)
    counts = []
    for step in (600, 700, 800, 900):
        refine(strategy, step, [1.0] * len(strategy.gaussians))
        counts.append(len(strategy.gaussians))
    # 8 + 16 sqrt(1/4, 2/4, 3/4, 1); all 8 may grow in the first.
    assert counts == [16, 19, 21, 24]
    strategy = strategy_within(budget=24 / 400)
    refine(strategy, 600, [1.0] * 8)
    strategy.gaussians.opacities.data[:10] = -9.0
    assert refine(strategy, 700, [0.0] * 16) == Refinement(pruned_opacity=10)
    assert refine(strategy, 800, [1.0] * 6) == Refinement(split=6)


def test_more_gaussians_than_the_budget_stay_and_do_not_grow() -> None:
    strategy = strategy_within(budget=5 / 400)
    for step in (600, 900):
        assert refine(strategy, step, [1.0] * 8) == Refinement()
    strategy.remove(torch.arange(8) >= 4)
    strategy.settings.stop = 1100
    assert refine(strategy, 1000, [1.0] * 4) == Refinement(split=1)


@pytest.mark.parametrize(
    ("settings", "last"),
    [
        (DensifySettings(), 14_900),
        (DensifySettings(stop=1001, every=500), 1000),
        (DensifySettings(stop=1000, every=500), 500),
        (DensifySettings().scaled(2000), 996),
    ],
)
def test_the_last_refinement(settings: DensifySettings, last: int) -> None:
    due = [step for step in range(settings.stop) if step % settings.every == 0]
    assert settings.last_refinement == due[-1] == last
