"""Section 5.4: the thresholds of each class; tests/splat tests what densification does."""

from __future__ import annotations

import pytest

from tests.training.components.conftest import Build
from xrgs.config import ComponentsConf
from xrgs.splat.settings import DensifySettings
from xrgs.splat.strategy.refinement import DECIDE, Groups, Thresholds


@pytest.fixture
def on(off: ComponentsConf) -> ComponentsConf:
    off.densify.decide, off.densify.lr_grow, off.densify.lr_prune = "per_class", 2.0, 3.0
    return off


@pytest.mark.parametrize("decide", DECIDE)
def test_lr_views_have_other_thresholds_and_hr_views_gsplats(
    decide: str, build: Build, on: ComponentsConf
) -> None:
    on.densify.decide = decide
    groups = build(on).densification_groups(DensifySettings(grow_grad2d=8e-4))
    hr, lr = Thresholds(8e-4, 0.005), Thresholds(16e-4, 0.015)
    assert groups == Groups({"HR": hr, "LR": lr}, decide)
    assert list(groups.thresholds) == ["HR", "LR"]  # the first has precedence in pruning
    on.densify.decide = "shared"
    assert build(on).densification_groups(DensifySettings()) is None
