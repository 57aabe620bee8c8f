"""Section 5.7: LR views are rendered with larger scales, and nothing else changes."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from tests.training.components.conftest import Build, make_view
from xrgs.config import ComponentsConf
from xrgs.splat.gaussians import PARAMETERS, Gaussians
from xrgs.training.components import Step


@pytest.fixture
def on(off: ComponentsConf) -> ComponentsConf:
    off.render_scale.gamma = 0.25
    return off


def test_the_scales_of_an_lr_view_are_inflated(
    build: Build, on: ComponentsConf, hr: Step, lr: Step, gaussians: Gaussians
) -> None:
    parts, plain = build(on), gaussians.activated()
    inflated = parts.before_render(plain, lr)
    factor = 5**0.25  # 75 px over 15
    torch.testing.assert_close(inflated.scales, plain.scales * factor)
    assert factor == pytest.approx(1.5, abs=0.01)
    for name in set(PARAMETERS) - {"scales"}:
        assert getattr(inflated, name) is getattr(plain, name)
    assert lr.log == {"render_scale.k": pytest.approx(factor)}
    assert parts.before_render(plain, hr) is plain


def test_the_trained_scales_stay_and_gradients_reach_them(
    build: Build, on: ComponentsConf, lr: Step, gaussians: Gaussians
) -> None:
    before = gaussians.scales.detach().clone()
    gaussians.scales.grad = None
    torch.autograd.backward(build(on).before_render(gaussians.activated(), lr).scales.sum())
    torch.testing.assert_close(gaussians.scales.grad, 5**0.25 * before.exp())
    assert torch.equal(gaussians.scales.detach(), before)


def test_resolution_is_the_longer_side_of_the_largest_view(
    build: Build, on: ComponentsConf, gaussians: Gaussians
) -> None:
    on.render_scale.gamma = 1.0
    turned, wide = make_view("LR", torch.zeros(40, 20, 3)), make_view("HR", torch.zeros(30, 80, 3))
    full = replace(make_view("LR", torch.zeros(30, 80, 3)), name="full")
    parts, plain = build(on, turned, wide, full), gaussians.activated()
    inflated = parts.before_render(plain, Step(0, 1, turned))
    torch.testing.assert_close(inflated.scales, plain.scales * 2)
    step = Step(0, 1, full)
    assert torch.equal(parts.before_render(plain, step).scales, plain.scales)
    assert step.log == {"render_scale.k": 1.0}  # the history shows that nothing was scaled
