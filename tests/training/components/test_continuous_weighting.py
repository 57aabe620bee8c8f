"""Conclusion of the paper: the weight of a view by its sampling rate, not by its tag."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import pytest
import torch

from xrgs.capture.dataset import LoadedView
from xrgs.config import ComponentsConf
from xrgs.splat.gaussians import Gaussians
from xrgs.training.components import Components, Step

#: The losses of these tests do not depend on the Gaussians.
NO_GAUSSIANS = Gaussians(*[torch.empty(0)] * 6)


@pytest.fixture
def view(lr: Step) -> LoadedView:
    assert isinstance(lr.view, LoadedView)
    return lr.view


def weight(parts: Components, view: LoadedView, number: int = 0) -> float:
    loss = torch.tensor(1.0, dtype=torch.float64)
    return parts.modify_loss(loss, view.image, NO_GAUSSIANS, Step(number, 30_000, view)).item()


@pytest.mark.parametrize(
    ("rho", "expected"), [(1.0, 1.0), (0.5, 0.5510), (0.2, 0.2505), (0.04, 0.06277)]
)
@pytest.mark.parametrize("tag", ["HR", "LR"])
def test_the_weight_is_a_power_of_the_rate_whatever_the_tag(
    tag: str,
    rho: float,
    expected: float,
    view: LoadedView,
    build: Callable[..., Components],
    off: ComponentsConf,
) -> None:
    off.continuous_weighting.gamma = 0.86
    view = dataclasses.replace(view, rho=rho, tag=tag)
    assert weight(build(off, view), view) == pytest.approx(expected, rel=1e-3)


def test_it_replaces_the_weight_by_tag(
    view: LoadedView, build: Callable[..., Components], off: ComponentsConf
) -> None:
    off.continuous_weighting.gamma = 1.0
    off.loss_weighting.lr_weight = 0.25
    view = dataclasses.replace(view, rho=0.5)
    assert weight(build(off, view), view) == 0.5


def test_the_hybrid_schedule_attenuates_it(
    view: LoadedView, build: Callable[..., Components], off: ComponentsConf
) -> None:
    off.continuous_weighting.gamma = 1.0
    off.hybrid_schedule.ramp = 5000
    view = dataclasses.replace(view, rho=0.5)
    parts = build(off, view)
    weights = [weight(parts, view, number) for number in (0, 17_500, 20_000)]
    assert weights == pytest.approx([0.5, 0.75, 1.0])
