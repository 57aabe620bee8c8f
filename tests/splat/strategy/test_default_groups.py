"""Densification with groups of views, against gsplat's `DefaultStrategy` run once for each."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from tests.splat.scenes import make_strategy
from tests.splat.strategy.gsplats import SCENE_SCALE, SIZES, Theirs, View, random_values
from xrgs.splat.gaussians import Gaussians
from xrgs.splat.settings import DensifySettings
from xrgs.splat.strategy.base import Groups, Refinement, Thresholds

FINE, COARSE = Thresholds(2e-4, 0.005), Thresholds(4e-4, 0.02)
#: Numbers of Gaussians, and the groups of the views in their order.
ANY_SCENE = given(
    count=st.integers(1, 60),
    order=st.text("hl", min_size=1, max_size=6),
    seed=st.integers(0, 2**32 - 1),
)


def values_of(count: int, rng: np.random.Generator) -> dict[str, Tensor]:
    """Gaussians on both sides of every threshold; `sh0` is their number, which copies inherit."""
    values = random_values(count, rng, scales=(np.log(0.003), np.log(0.1)), opacities=(-7, -3))
    return values | {"sh0": torch.arange(count).float()[:, None, None].repeat(1, 1, 3)}


def view_of(group: str, count: int, rng: np.random.Generator) -> View:
    """Some Gaussians are not visible; some are, and have no gradient: they are behind others."""
    visible = torch.from_numpy(rng.random(count) < 0.8)
    drawn = visible & torch.from_numpy(rng.random(count) < 0.6)
    half = max(SIZES[group]) / 2
    gradient = rng.normal(size=(count, 2)) * rng.exponential(5e-4, size=(count, 1)) / half
    return View(torch.from_numpy(gradient).float() * drawn[:, None], visible, group=group)


def views_of(groups: str, count: int, rng: np.random.Generator) -> list[View]:
    return [view_of({"h": "HR", "l": "LR"}[letter], count, rng) for letter in groups]


def ours(
    values: dict[str, Tensor], views: list[View], groups: Groups | None, step: int = 600
) -> tuple[Gaussians, Refinement]:
    """The Gaussians after steps on some views, at the last of which they are refined."""
    strategy = make_strategy(values, scene_scale=SCENE_SCALE, groups=groups)
    refinement = Refinement()
    for view in views:
        width, height = SIZES[view.group]
        assert refinement == Refinement()
        refinement = strategy.after_step(
            step if view is views[-1] else 1,
            view.gradient,
            view.visible,
            width=width,
            height=height,
            group=view.group,
        )
    return strategy.gaussians, refinement


def numbers(gaussians: Gaussians) -> Counter[int]:
    """How many Gaussians there are now of each former one."""
    return Counter(gaussians.sh0[:, 0, 0].int().tolist())


def gsplats(values: dict[str, Tensor], views: list[View], thresholds: Thresholds) -> Counter[int]:
    """The same by gsplat, which has one pair of thresholds."""
    config = DensifySettings(
        grow_grad2d=thresholds.grow_grad2d, prune_opacity=thresholds.prune_opacity
    )
    theirs = Theirs(values, config)
    for view in views:
        theirs.densify(600 if view is views[-1] else 1, view)
    return Counter(theirs.params["sh0"][:, 0, 0].int().tolist())


@settings(max_examples=30)
@ANY_SCENE
def test_each_group_grows_by_its_own_statistics(count: int, order: str, seed: int) -> None:
    rng = np.random.default_rng(seed)
    values, views = values_of(count, rng), views_of(order, count, rng)
    fine, coarse = (Thresholds(each.grow_grad2d, 0.0) for each in (FINE, COARSE))
    gaussians, refinement = ours(values, views, Groups({"HR": fine, "LR": coarse}, "per_class"))
    expected: dict[str, set[int]] = {}
    for group, thresholds in (("HR", fine), ("LR", coarse)):
        seen = [view for view in views if view.group == group]
        found = gsplats(values, seen, thresholds) if seen else Counter()
        expected[group] = {number for number, copies in found.items() if copies == 2}
    grown = expected["HR"] | expected["LR"]
    assert numbers(gaussians) == Counter(range(count)) + Counter(grown)
    assert refinement.duplicated + refinement.split == len(grown)
    assert refinement.by_group["grown_HR"] == len(expected["HR"])
    assert refinement.by_group["grown_LR"] == len(expected["LR"])


@settings(max_examples=30)
@ANY_SCENE
def test_an_hr_views_gaussian_is_pruned_by_the_hr_threshold(
    count: int, order: str, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    values, views = values_of(count, rng), views_of(order, count, rng)
    fine, coarse = (Thresholds(float("inf"), each.prune_opacity) for each in (FINE, COARSE))
    gaussians, refinement = ours(values, views, Groups({"HR": fine, "LR": coarse}, "per_class"))
    drawn = torch.zeros(count, dtype=torch.bool)
    for view in views:
        if view.group == "HR":
            drawn |= (view.gradient != 0).any(dim=1)
    by_fine, by_coarse = (gsplats(values, views, each) for each in (fine, coarse))
    expected = [n for n in range(count) if (by_fine if drawn[n] else by_coarse)[n]]
    assert numbers(gaussians) == Counter(expected)
    by_hr = sum(1 for n in range(count) if drawn[n] and not by_fine[n])
    assert refinement.by_group["pruned_opacity_HR"] == by_hr
    assert refinement.by_group["pruned_opacity_LR"] == refinement.pruned_opacity - by_hr
    assert refinement.pruned_opacity == count - len(expected)


def test_copies_and_halves_are_pruned_by_their_parents_threshold() -> None:
    values = values_of(4, np.random.default_rng(0))
    values["opacities"] = torch.logit(torch.full((4,), 0.01))  # between the two thresholds
    values["scales"] = torch.tensor([0.005, 0.005, 0.1, 0.1]).log()[:, None].repeat(1, 3)
    gradient = torch.ones(4, 2)
    every = torch.ones(4, dtype=torch.bool)
    by_hr = torch.tensor([True, False, True, False])  # a copy and a split of each
    views = [View(gradient * by_hr[:, None], every, group="HR"), View(gradient, every, group="LR")]
    gaussians, refinement = ours(values, views, Groups({"HR": FINE, "LR": COARSE}, "per_class"))
    assert (refinement.duplicated, refinement.split, refinement.pruned_opacity) == (2, 2, 4)
    assert numbers(gaussians) == Counter({0: 2, 2: 2})


@pytest.mark.parametrize("order", ["hlh", "hll"])
def test_pooled_the_last_view_decides_for_all(order: str) -> None:
    rng = np.random.default_rng(1)
    values, views = values_of(200, rng), views_of(order, 200, rng)
    thresholds = {"HR": FINE, "LR": COARSE}
    gaussians, refinement = ours(values, views, Groups(thresholds, "current_view"))
    last = views[-1].group
    assert numbers(gaussians) == gsplats(values, views, thresholds[last])
    others = {key: n for key, n in refinement.by_group.items() if not key.endswith(last)}
    assert set(others.values()) == {0}
    assert refinement.by_group[f"pruned_opacity_{last}"] == refinement.pruned_opacity > 0
    assert refinement.by_group[f"grown_{last}"] == refinement.duplicated + refinement.split > 0


@settings(max_examples=30)
@ANY_SCENE
def test_by_own_thresholds_all_views_share_one_mean(count: int, order: str, seed: int) -> None:
    """As gsplat with a threshold of 1, and each gradient divided by its view's threshold."""
    rng = np.random.default_rng(seed)
    values, views = values_of(count, rng), views_of(order, count, rng)
    thresholds = {
        group: Thresholds(each.grow_grad2d, 0.0) for group, each in (("HR", FINE), ("LR", COARSE))
    }
    gaussians, _ = ours(values, views, Groups(thresholds, "own_threshold"))
    scaled = [
        View(view.gradient / thresholds[view.group].grow_grad2d, view.visible, group=view.group)
        for view in views
    ]
    assert numbers(gaussians) == gsplats(values, scaled, Thresholds(1.0, 0.0))


def test_the_reset_is_above_every_threshold() -> None:
    values = values_of(50, np.random.default_rng(3))
    values["opacities"] += 6
    for thresholds in ({"HR": FINE, "LR": COARSE}, {"HR": COARSE, "LR": FINE}):
        views = views_of("l", 50, np.random.default_rng(0))
        gaussians, refinement = ours(values, views, Groups(thresholds, "per_class"), step=3000)
        assert refinement.reset > 0
        highest = torch.sigmoid(gaussians.opacities.detach()).max().item()
        assert highest == pytest.approx(2 * COARSE.prune_opacity)
