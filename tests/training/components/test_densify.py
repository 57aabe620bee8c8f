"""Section 5.4: the thresholds of each class; tests/splat tests what densification does."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from xrgs.config import ComponentsConf
from xrgs.splat.settings import DensifySettings
from xrgs.splat.strategy.refinement import DECIDE, Groups, Thresholds
from xrgs.training.components import Components

Build = Callable[..., Components]


@pytest.fixture
def on(off: ComponentsConf) -> ComponentsConf:
    off.densify.decide, off.densify.lr_grow, off.densify.lr_prune = "per_class", 2.0, 3.0
    return off


@pytest.mark.parametrize("decide", DECIDE)
def test_lr_views_have_other_thresholds_and_hr_views_gsplats(
    decide: str, build: Build, on: ComponentsConf
) -> None:
    on.densify.decide = decide
    groups = build(on).densification_groups(DensifySettings())
    hr, lr = Thresholds(2e-4, 0.005), Thresholds(4e-4, 0.015)
    assert groups == Groups({"HR": hr, "LR": lr}, decide)
    assert list(groups.thresholds) == ["HR", "LR"]  # the first has precedence in pruning


def test_the_thresholds_follow_the_settings_of_densification(
    build: Build, on: ComponentsConf
) -> None:
    groups = build(on).densification_groups(DensifySettings(grow_grad2d=8e-4, prune_opacity=0.1))
    assert groups is not None
    assert groups.thresholds["HR"] == Thresholds(8e-4, 0.1)
    assert groups.thresholds["LR"].grow_grad2d == pytest.approx(16e-4)


def test_the_baseline_has_no_groups_of_views(build: Build, off: ComponentsConf) -> None:
    assert build(off).densification_groups(DensifySettings()) is None
    off.loss_weighting.lr_weight = 0.25
    assert build(off).densification_groups(DensifySettings()) is None
