"""The weight of a view: between its view weight and 1, and a factor of its whole loss."""

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
from xrgs.splat.gaussians import Gaussians
from xrgs.splat.loss import photometric_loss, prepare_target
from xrgs.training.components import Components, Step
from xrgs.training.components.weighting import Weighting

#: The losses of these tests do not depend on the Gaussians.
NO_GAUSSIANS = Gaussians(*[torch.empty(0)] * 6)

unit = st.floats(0, 1)
VIEW = LoadedView("low", "LR", Camera(torch.eye(4), torch.eye(3), 15, 12), torch.rand(12, 15, 3))
STEP = Step(0, 30_000, VIEW)


def constant(value: float) -> Callable[[object], float]:
    return lambda _: value


def weighting(view_weight: float, *attenuations: float, **options: Any) -> Weighting:
    return Weighting(constant(view_weight), [constant(a) for a in attenuations], **options)


@pytest.mark.parametrize(
    ("attenuations", "expected"), [((), 0.25), ((1.0,), 0.25), ((0.5, 0.8), 0.7), ((0.5, 0.0), 1.0)]
)
def test_attenuations_multiply(attenuations: tuple[float, ...], expected: float) -> None:
    component = weighting(0.25, *attenuations)
    assert component.weight(STEP) == pytest.approx(expected, rel=1e-12)
    loss = torch.tensor(2.0, dtype=torch.float64)
    assert component.modify_loss(loss, VIEW.image, NO_GAUSSIANS, STEP).item() == pytest.approx(
        2 * expected, rel=1e-12
    )


@given(base=unit, attenuations=st.lists(unit, max_size=3), pixels=st.lists(unit, min_size=180))
def test_every_weight_lies_between_the_view_weight_and_1(
    base: float, attenuations: list[float], pixels: list[float]
) -> None:
    region = torch.tensor(pixels[:180], dtype=torch.float64).reshape(12, 15)
    component = weighting(base, *attenuations, regions={"low": region})
    weight = component.weight(STEP)
    assert base - 1e-12 <= weight <= 1 + 1e-12
    relative = component.pixel_weights(STEP)
    if weight > 1e-9:
        assert relative is not None
        assert relative.mean().item() == pytest.approx(1, rel=1e-9)
        assert (weight * relative >= base - 1e-12).all()
        assert (weight * relative <= 1 + 1e-12).all()


def test_a_weight_of_1_is_the_identity() -> None:
    component = weighting(1.0, 0.5, stat_from="unweighted")
    loss, gradient = torch.tensor(0.3), torch.rand(4, 2)
    assert component.modify_loss(loss, VIEW.image, NO_GAUSSIANS, STEP) is loss
    assert component.densification_grad2d(gradient, STEP) is gradient
    assert component.pixel_weights(STEP) is None


def test_pixel_weights_weight_the_loss_of_every_pixel() -> None:
    """The view's weight times the loss with relative weights is the loss with the weights."""
    generator = torch.Generator().manual_seed(0)
    image, photograph, region = (
        torch.rand(*shape, generator=generator, dtype=torch.float64)
        for shape in ((12, 15, 3), (12, 15, 3), (12, 15))
    )
    target = prepare_target(photograph)
    component = weighting(0.25, 0.6, regions={"low": region})
    relative = component.pixel_weights(STEP)
    loss = photometric_loss(image, target, l1=0.8, ssim=0.2, pixel_weight=relative)
    weights = 1 - 0.75 * 0.6 * region
    expected = photometric_loss(image, target, l1=0.8, ssim=0.2, pixel_weight=weights)
    value = component.modify_loss(loss, image, NO_GAUSSIANS, STEP).item()
    assert value == pytest.approx(expected.item(), rel=1e-12)


def test_a_weight_of_0_everywhere_has_no_pixel_weights() -> None:
    """Relative weights would be 0 / 0."""
    component = weighting(0.0, regions={"low": torch.ones(12, 15)})
    assert component.weight(STEP) == 0
    assert component.pixel_weights(STEP) is None


@pytest.mark.parametrize("base", [0.25, 0.0])
def test_densification_can_read_the_gradient_without_the_weight(base: float) -> None:
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
def test_attenuating_a_weight_that_is_off_is_refused(
    key: str, value: float, build: Callable[..., Components], off: ComponentsConf
) -> None:
    group, name = key.split(".")
    setattr(getattr(off, group), name, value)
    with pytest.raises(XrgsError, match=rf"components\.{key}={value}: .*loss_weighting\.lr_weight"):
        build(off)
    off.loss_weighting.lr_weight = 0.25
    assert [type(component) for component in build(off)] == [Weighting]
