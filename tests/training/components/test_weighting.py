"""Sections 5.2 and 7.2: the weight of a view, between its view weight and 1."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from tests.splat.scenes import noise
from tests.training.components.conftest import NO_GAUSSIANS, Build, make_view
from xrgs.config import ComponentsConf, Conf
from xrgs.splat.cameras import Camera
from xrgs.splat.loss import photometric_loss, prepare_target
from xrgs.training import components
from xrgs.training.components import Component, Components, Step, TrainingView
from xrgs.training.components.weighting import (
    Weighting,
    coverage,
    gradient_magnitude,
    region_attenuations,
    scheduled_attenuation,
)
from xrgs.training.dataset import Dataset, LoadedView

unit = st.floats(0, 1)
VIEW = LoadedView("low", "LR", Camera(torch.eye(4), torch.eye(3), 15, 12), torch.rand(12, 15, 3))
STEP = Step(0, 30_000, VIEW)
NEAR = 0.01


def constant(value: float) -> Callable[[object], float]:
    return lambda _: value


def weighting(view_weight: float, *attenuations: float, **options: Any) -> Weighting:
    return Weighting(constant(view_weight), [constant(a) for a in attenuations], **options)


def weight(parts: Components | Component, view: TrainingView, number: int = 0) -> float:
    """The factor of the loss of a view at a step of 30,000."""
    loss = torch.tensor(1.0, dtype=torch.float64)
    return parts.modify_loss(loss, view.image, NO_GAUSSIANS, Step(number, 30_000, view)).item()


@settings(max_examples=30)
@given(base=unit, attenuations=st.lists(unit, max_size=3), seed=st.integers(0, 10**6))
def test_every_weight_lies_between_the_view_weight_and_1(
    base: float, attenuations: list[float], seed: int
) -> None:
    region = noise(12, 15, seed)[..., 0].round(decimals=seed % 3)  # of 0 and 1 alone, or between
    component = weighting(base, *attenuations, regions={"low": region})
    of_view = component.weight(STEP)
    assert base - 1e-12 <= of_view <= 1 + 1e-12
    relative = component.pixel_weights(STEP)
    if of_view > 1e-9:
        assert relative is not None
        assert relative.mean().item() == pytest.approx(1, rel=1e-9)
        assert (of_view * relative >= base - 1e-12).all()
        assert (of_view * relative <= 1 + 1e-12).all()


def test_pixel_weights_weight_the_loss_of_every_pixel() -> None:
    """The view's weight times the loss with relative weights is the loss with the weights."""
    generator = torch.Generator().manual_seed(0)
    image, photograph, region = (
        torch.rand(*shape, generator=generator, dtype=torch.float64)
        for shape in ((12, 15, 3), (12, 15, 3), (12, 15))
    )
    target = prepare_target(photograph)
    component = weighting(0.25, 0.6, 0.5, regions={"low": region})  # attenuations multiply
    relative = component.pixel_weights(STEP)
    loss = photometric_loss(image, target, l1=0.8, ssim=0.2, pixel_weight=relative)
    weights = 1 - 0.75 * 0.6 * 0.5 * region
    expected = photometric_loss(image, target, l1=0.8, ssim=0.2, pixel_weight=weights)
    value = component.modify_loss(loss, image, NO_GAUSSIANS, STEP).item()
    assert value == pytest.approx(expected.item(), rel=1e-12)


@pytest.mark.parametrize("base", [0.25, 0.0])
def test_densification_can_read_the_gradient_without_the_weight(base: float) -> None:
    region = torch.zeros(12, 15)
    region[:6] = 1.0
    gradient = torch.rand(4, 2)
    component = weighting(base, regions={"low": region}, stat_from="unweighted")
    torch.testing.assert_close(
        component.densification_grad2d(gradient, STEP), gradient / ((1 + base) / 2)
    )
    assert weighting(base, stat_from="weighted").densification_grad2d(gradient, STEP) is gradient
    # A weight of 0 everywhere: relative weights would be 0 / 0.
    zero = weighting(0.0, regions={"low": torch.ones(12, 15)}, stat_from="unweighted")
    assert zero.densification_grad2d(gradient, STEP) is gradient
    assert zero.weight(STEP) == 0
    assert zero.pixel_weights(STEP) is None
    # A weight of 1 is the identity.
    one, loss = weighting(1.0, 0.5, stat_from="unweighted"), torch.tensor(0.3)
    assert one.modify_loss(loss, VIEW.image, NO_GAUSSIANS, STEP) is loss
    assert one.densification_grad2d(gradient, STEP) is gradient
    assert one.pixel_weights(STEP) is None


# By tag (section 5.2).


def test_the_loss_of_an_lr_view_and_its_gradient_are_weighted(
    build: Build, off: ComponentsConf, hr: Step, lr: Step
) -> None:
    off.loss_weighting.lr_weight = 0.25
    parts, x = build(off), torch.rand(4, 2, requires_grad=True)
    plain = (x**2).sum()
    weighted = parts.modify_loss(plain, lr.view.image, NO_GAUSSIANS, lr)
    (gradient,) = torch.autograd.grad(weighted, x, retain_graph=True)
    torch.testing.assert_close(gradient, 0.5 * x.detach())
    assert parts.modify_loss(plain, hr.view.image, NO_GAUSSIANS, hr) is plain
    assert (lr.log, hr.log) == ({"weighting.LR": 0.25}, {})
    assert parts.densification_grad2d(gradient, lr) is gradient
    off.loss_weighting.stat_from = "unweighted"
    assert torch.equal(build(off).densification_grad2d(gradient, lr), 2 * x)
    assert build(off).densification_grad2d(gradient, hr) is gradient


# By sampling rate (conclusion).


@pytest.mark.parametrize(
    ("rho", "expected", "tag"), [(1.0, 1.0, "LR"), (0.5, 0.5510, "HR"), (0.2, 0.2505, "LR")]
)
def test_the_weight_is_a_power_of_the_rate_whatever_the_tag(
    tag: str, rho: float, expected: float, build: Build, off: ComponentsConf
) -> None:
    off.continuous_weighting.gamma = 0.86
    off.loss_weighting.lr_weight = 0.5  # not read
    view = dataclasses.replace(VIEW, sampling_rate=rho, tag=tag)
    assert weight(build(off, view), view) == pytest.approx(expected, rel=1e-3)


# The hybrid schedule (section 7.2, proposal 3).


def test_the_weight_of_lr_views_rises_after_densification(
    build: Build, off: ComponentsConf, hr: Step, lr: Step
) -> None:
    off.loss_weighting.lr_weight, off.hybrid_schedule.ramp = 0.25, 5000
    parts, loss = build(off), torch.tensor(1.0, dtype=torch.float64)
    rise = {0: 0.25, 1_500: 0.25, 1_750: 0.625, 2_000: 1.0, 2_999: 1.0}
    for number, expected in rise.items():
        step = Step(number, 3_000, lr.view)
        weighted = parts.modify_loss(loss, lr.view.image, NO_GAUSSIANS, step).item()
        assert weighted == pytest.approx(expected, rel=1e-12)
        assert step.log == {"weighting.LR": weighted}
        assert weight(parts, hr.view, number) == 1
    steps = [Step(number, 30_000, VIEW) for number in (2000, 2400, 3000)]
    attenuations = [scheduled_attenuation(step, start=2000, ramp=1000) for step in steps]
    assert attenuations == pytest.approx([1.0, 0.6, 0.0])


# By the texture of the scene (section 7.2, proposal 1).


def ramp(slope: float) -> Tensor:
    """An image [12, 15, 3] whose gradient has the magnitude `slope` everywhere."""
    y, x = torch.meshgrid(torch.arange(12.0), torch.arange(15.0), indexing="ij")
    return (slope * (0.6 * x + 0.8 * y)).double()[..., None].expand(-1, -1, 3)


def test_the_gradient_is_the_root_mean_square_over_channels() -> None:
    for factors, mean_square in (((1.0, 1.0, 1.0), 1.0), ((1.0, 2.0, 3.0), 14 / 3)):
        expected = torch.full((12, 15), 0.03 * mean_square**0.5, dtype=torch.float64)
        magnitude = gradient_magnitude(ramp(0.03) * torch.tensor(factors))
        torch.testing.assert_close(magnitude, expected)


@pytest.mark.parametrize(
    ("slopes", "expected"),
    [([0.0], 1.0), ([0.14], 0.25), ([0.02, 0.04], 1 - 0.75 * 0.3)],  # the mean of both views
)
def test_the_weight_falls_to_lr_weight_as_texture_rises(
    slopes: list[float], expected: float, off: ComponentsConf, build: Build
) -> None:
    off.loss_weighting.lr_weight, off.adaptive_weighting.texture = 0.25, 0.1
    low, high = [make_view("LR", ramp(slope)) for slope in slopes], make_view("HR", ramp(0.2))
    parts = build(off, *low, high)
    for view in low:
        assert weight(parts, view) == pytest.approx(expected, rel=1e-6)
    assert weight(parts, high) == 1


# By region (section 7.2, proposal 2).


def camera(size: int, *, x: float = 0.0, focal: float | None = None) -> Camera:
    """A camera that sees -1 to 1 around `x` at depth 2, unless its focal length is another."""
    K = torch.tensor([[focal or size, 0, size / 2], [0, focal or size, size / 2], [0, 0, 1]])
    viewmat = torch.eye(4)
    viewmat[0, 3] = -x
    return Camera(viewmat, K.float(), size, size)


def wall(depth: float) -> Tensor:
    """Points [P, 3] of a wall that fills the views of cameras near the origin."""
    y, x = torch.meshgrid(torch.linspace(-4, 4, 41), torch.linspace(-4, 4, 41), indexing="ij")
    return torch.stack([x, y, torch.full_like(x, depth)], dim=-1).reshape(-1, 3)


def checks(size: int, rows: int) -> Tensor:
    """An image [size, size, 3]: a chequered pattern in the first `rows`, grey below."""
    image = torch.full((size, size, 3), 0.5)
    y, x = torch.meshgrid(torch.arange(rows), torch.arange(size), indexing="ij")
    image[:rows] = ((x + y) % 2)[..., None].float()
    return image


@pytest.mark.parametrize(("depth", "first"), [(2.0, 10), (4.0, 5)])
def test_coverage_is_by_depth_and_camera(depth: float, first: int) -> None:
    covered = coverage(camera(20), [camera(100, x=1.0)], wall(depth), NEAR)
    expected = torch.zeros(20, 20, dtype=torch.bool)
    expected[:, first:] = True
    assert torch.equal(covered, expected)
    # Views cover together.
    both = coverage(camera(20), [camera(100, x=1.0), camera(100, x=-1.0)], wall(depth), NEAR)
    assert torch.equal(both, expected | expected.flip(1))


@pytest.mark.parametrize(
    ("others", "points"),
    [
        ([camera(20)], wall(2.0)),  # the same sampling rate
        ([camera(100, focal=20)], wall(2.0)),  # a larger image of the same sampling rate
        ([camera(100, x=5.0)], wall(2.0)),  # another part of the wall
        ([camera(100)], wall(-2.0)),  # points behind the camera
        ([camera(100)], wall(NEAR / 2)),  # nearer than `near`
        ([], wall(2.0)),
    ],
)
def test_what_is_not_covered(others: list[Camera], points: Tensor) -> None:
    assert not coverage(camera(20), others, points, NEAR).any()


def test_a_few_stray_points_do_not_move_the_depth() -> None:
    """Two points between the camera and the wall, in view, that would move a mean of depths."""
    stray = torch.tensor([[0.0, 0.0, 0.1], [-0.2, 0.0, 0.5]])
    others = [camera(100, x=1.0)]
    alone = coverage(camera(20), others, stray, NEAR)
    expected = coverage(camera(20), others, wall(2.0), NEAR)
    assert not torch.equal(alone, expected)
    both = coverage(camera(20), others, torch.cat([wall(2.0), stray]), NEAR)
    assert torch.equal(both, expected)


LOW = LoadedView("low", "LR", camera(20), checks(20, 10))
HIGH = LoadedView("high", "HR", camera(100, x=1.0), checks(100, 100))


def attenuation_of_low(texture: float) -> Tensor:
    found = region_attenuations([LOW, HIGH], wall(2.0), texture=texture, near=NEAR)
    assert set(found) == {"low"}
    return found["low"]


def test_textured_and_covered_pixels_alone_are_attenuated() -> None:
    attenuation = attenuation_of_low(0.07)
    assert (attenuation[:9, 10:] == 1).all()
    assert (attenuation[:, :10] == 0).all()  # no HR view covers these
    assert (attenuation[13:] == 0).all()  # these are flat
    # In proportion: the gradient of a chequered pattern is 1 along both axes.
    coarse = attenuation_of_low(8.0)
    torch.testing.assert_close(coarse[:7, 10:], torch.full((7, 10), 2**0.5 / 8))
    torch.testing.assert_close(attenuation_of_low(16.0), coarse / 2)


def test_training_gives_attenuated_pixels_less_weight(baseline: Conf) -> None:
    conf = baseline.components
    conf.loss_weighting.lr_weight, conf.region_weighting.texture = 0.25, 0.07
    points = wall(2.0)
    data = Dataset((LOW, HIGH), (), points, points, 1.0, 5)
    parts = components.build(conf, data, baseline.splat)
    relative = parts.pixel_weights(Step(0, 30_000, LOW))
    assert relative is not None
    weights = relative * weight(parts, LOW)
    torch.testing.assert_close(weights, 1 - 0.75 * attenuation_of_low(0.07))
    assert weights.min() < 0.26
    assert weights.max() > 0.99
    assert parts.pixel_weights(Step(0, 30_000, HIGH)) is None
    assert weight(parts, HIGH) == 1
