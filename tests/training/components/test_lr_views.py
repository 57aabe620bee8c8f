"""Sections 5.3, 5.4, 5.5 and 5.7: what the paper does to LR views leaves HR views alone."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from tests.training.components.conftest import Build, gaussians_with_gradients, make_view
from xrgs.config import ComponentsConf
from xrgs.errors import XrgsError
from xrgs.splat.gaussians import PARAMETERS, Gaussians
from xrgs.splat.settings import DECIDE, DensifySettings
from xrgs.splat.strategy.base import Groups, Thresholds
from xrgs.training.components import Step

# Gradient scaling (5.3).


@pytest.mark.parametrize(("tag", "factor"), [("LR", 0.3), ("HR", 1.0)])
def test_only_the_scales_gradient_is_scaled(
    tag: str, factor: float, build: Build, off: ComponentsConf, steps: dict[str, Step]
) -> None:
    gaussians, plain = (gaussians_with_gradients() for _ in range(2))
    off.gradient_scaling.lr_scale = 0.3
    build(off).after_backward(gaussians, steps[tag])
    for name in PARAMETERS:
        after, before = gaussians[name].grad, plain[name].grad
        assert after is not None
        assert before is not None
        assert torch.equal(after, before * (factor if name == "scales" else 1.0)), name
    norm = plain.scales.grad.norm().item()  # type: ignore[union-attr]
    assert steps[tag].log == {f"gradient_scaling.norm_{tag}": pytest.approx(norm)}


# Densification (5.4); tests/splat tests what it does.


@pytest.mark.parametrize("decide", DECIDE)
def test_lr_views_have_other_thresholds_and_hr_views_gsplats(
    decide: str, build: Build, off: ComponentsConf
) -> None:
    off.densify.lr_grow, off.densify.lr_prune = 2.0, 3.0
    assert build(off).densification_groups(DensifySettings()) is None
    off.densify.decide = decide
    groups = build(off).densification_groups(DensifySettings(grow_grad2d=8e-4))
    hr, lr = Thresholds(8e-4, 0.005), Thresholds(16e-4, 0.015)
    assert groups == Groups({"HR": hr, "LR": lr}, decide)
    assert list(groups.thresholds) == ["HR", "LR"]  # the first has precedence in pruning


# The warm-up on LR views (5.5).


def test_hr_views_wait_until_the_warm_up_is_over(
    build: Build, off: ComponentsConf, hr: Step, lr: Step
) -> None:
    off.curriculum.lr_only = 5000
    parts = build(off)
    for number, total, allowed in (
        *((0, 3_000, False), (499, 3_000, False), (500, 3_000, True)),
        *((4_999, 30_000, False), (5_000, 30_000, True)),
    ):
        assert parts.allows_view(replace(hr, number=number, total=total)) == allowed
        assert parts.allows_view(replace(lr, number=number, total=total))
    with pytest.raises(XrgsError, match=r"^components\.curriculum\.lr_only=5000: .*no LR view"):
        build(off, hr.view)


# Resolution-aware rendering (5.7).


def test_the_scales_of_an_lr_view_are_inflated_for_the_render(
    build: Build, off: ComponentsConf, hr: Step, lr: Step, gaussians: Gaussians
) -> None:
    off.render_scale.gamma = 0.25
    parts, plain = build(off), gaussians.activated()
    inflated = parts.before_render(plain, lr)
    factor = 5**0.25  # 75 px over 15
    torch.testing.assert_close(inflated.scales, plain.scales * factor)
    assert factor == pytest.approx(1.5, abs=0.01)
    for name in set(PARAMETERS) - {"scales"}:
        assert getattr(inflated, name) is getattr(plain, name)
    assert lr.log == {"render_scale.k": pytest.approx(factor)}
    assert parts.before_render(plain, hr) is plain
    # The trained scales stay, and gradients reach them.
    before = gaussians.scales.detach().clone()
    gaussians.scales.grad = None
    torch.autograd.backward(inflated.scales.sum())
    torch.testing.assert_close(gaussians.scales.grad, factor * before.exp())
    assert torch.equal(gaussians.scales.detach(), before)


def test_resolution_is_the_longer_side_of_the_largest_view(
    build: Build, off: ComponentsConf, gaussians: Gaussians
) -> None:
    off.render_scale.gamma = 1.0
    turned, wide = make_view("LR", torch.zeros(40, 20, 3)), make_view("HR", torch.zeros(30, 80, 3))
    full = replace(make_view("LR", torch.zeros(30, 80, 3)), name="full")
    parts, plain = build(off, turned, wide, full), gaussians.activated()
    inflated = parts.before_render(plain, Step(0, 1, turned))
    torch.testing.assert_close(inflated.scales, plain.scales * 2)
    step = Step(0, 1, full)
    assert torch.equal(parts.before_render(plain, step).scales, plain.scales)
    assert step.log == {"render_scale.k": 1.0}  # the history shows that nothing was scaled
