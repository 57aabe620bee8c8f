"""One weight a view, whatever weighs it: between its base and 1, and times its whole loss."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from xrgs.capture.dataset import LoadedView
from xrgs.config import ComponentsConf
from xrgs.errors import XrgsError
from xrgs.splat.cameras import Camera
from xrgs.splat.loss import photometric_loss, prepare_target
from xrgs.training.components import Components, Step
from xrgs.training.components.weighting import Weighting

unit = st.floats(0, 1)
VIEW = LoadedView("low", "LR", Camera(torch.eye(4), torch.eye(3), 15, 12), torch.rand(12, 15, 3))
STEP = Step(0, 30_000, VIEW)


def weighting(base: float, *shares: float, **options: Any) -> Weighting:
    return Weighting(lambda _: base, [lambda _, s=s: s for s in shares], **options)


@pytest.mark.parametrize(
    ("shares", "expected"), [((), 0.25), ((1.0,), 0.25), ((0.5, 0.8), 0.7), ((0.5, 0.0), 1.0)]
)
def test_shares_multiply_what_the_base_takes(shares: tuple[float, ...], expected: float) -> None:
    component = weighting(0.25, *shares)
    assert component.weight(STEP) == pytest.approx(expected, rel=1e-12)
    loss = torch.tensor(2.0, dtype=torch.float64)
    assert component.loss(loss, VIEW.image, STEP).item() == pytest.approx(2 * expected, rel=1e-12)


@given(base=unit, shares=st.lists(unit, max_size=3), pixels=st.lists(unit, min_size=180))
def test_no_weight_leaves_its_base_to_1(
    base: float, shares: list[float], pixels: list[float]
) -> None:
    region = torch.tensor(pixels[:180], dtype=torch.float64).reshape(12, 15)
    component = weighting(base, *shares, regions={"low": region})
    weight = component.weight(STEP)
    assert base - 1e-12 <= weight <= 1 + 1e-12
    relative = component.pixel_weight(STEP)
    if weight > 1e-9:
        assert relative is not None
        assert relative.mean().item() == pytest.approx(1, rel=1e-9)
        assert (weight * relative >= base - 1e-12).all()
        assert (weight * relative <= 1 + 1e-12).all()


def test_a_weight_of_1_gives_back_what_it_was_given() -> None:
    component = weighting(1.0, 0.5, stat_from="unweighted")
    loss, gradient = torch.tensor(0.3), torch.rand(4, 2)
    assert component.loss(loss, VIEW.image, STEP) is loss
    assert component.densification_grad2d(gradient, STEP) is gradient
    assert component.pixel_weight(STEP) is None


def test_a_share_of_every_pixel_weighs_the_loss_of_every_pixel() -> None:
    """The view's weight times the loss of relative weights: the loss of the weights themselves."""
    generator = torch.Generator().manual_seed(0)
    image, photograph, region = (
        torch.rand(*shape, generator=generator, dtype=torch.float64)
        for shape in ((12, 15, 3), (12, 15, 3), (12, 15))
    )
    target = prepare_target(photograph)
    component = weighting(0.25, 0.6, regions={"low": region})
    relative = component.pixel_weight(STEP)
    loss = photometric_loss(image, target, l1=0.8, ssim=0.2, pixel_weight=relative)
    weights = 1 - 0.75 * 0.6 * region
    expected = photometric_loss(image, target, l1=0.8, ssim=0.2, pixel_weight=weights)
    value = component.loss(loss, image, STEP).item()
    assert value == pytest.approx(expected.item(), rel=1e-12)


@pytest.mark.parametrize("base", [0.25, 0.0])
def test_the_statistic_is_freed_of_the_mean_weight(base: float) -> None:
    region = torch.zeros(12, 15)
    region[:6] = 1.0
    gradient = torch.rand(4, 2)
    component = weighting(base, regions={"low": region}, stat_from="unweighted")
    torch.testing.assert_close(
        component.densification_grad2d(gradient, STEP), gradient / ((1 + base) / 2)
    )
    assert weighting(0.0, stat_from="unweighted").densification_grad2d(gradient, STEP) is gradient
    assert weighting(base, stat_from="weighted").densification_grad2d(gradient, STEP) is gradient


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("adaptive_weighting.texture", 0.07),
        ("region_weighting.texture", 0.07),
        ("hybrid_schedule.ramp", 5000),
    ],
)
def test_where_nothing_is_taken_nothing_can_be_given_back(
    key: str, value: float, build: Callable[..., Components], off: ComponentsConf
) -> None:
    group, name = key.split(".")
    setattr(getattr(off, group), name, value)
    with pytest.raises(XrgsError, match=rf"components\.{key}={value}: .*loss_weighting\.lr_weight"):
        build(off)
    off.loss_weighting.lr_weight = 0.25
    assert [type(component) for component in build(off)] == [Weighting]
