"""The learned blur of LR photographs: against a known blur, torch's Adam and scipy."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter
from torch import Tensor

from tests.splat.scenes import noise
from tests.training.components.conftest import Build, make_view
from xrgs.config import ComponentsConf, FormationConf
from xrgs.splat.gaussians import Gaussians
from xrgs.splat.resample import resize
from xrgs.training.components import Step
from xrgs.training.components.supersampled import BOX, BlurWidths
from xrgs.training.dataset import LoadedView

LOW = replace(make_view("LR", noise(12, 15, 1)), name="low")
OTHER = replace(make_view("LR", noise(12, 15, 2)), name="other")


@pytest.fixture
def on(off: ComponentsConf) -> ComponentsConf:
    off.formation.widths = "tag"
    off.supersampled.factor = off.supersampled.late_factor = 2
    return off


def widths(of: str = "tag", lr: float = 0.01, prior: float = 0.0) -> BlurWidths:
    """Those of the views `low` and `other`."""
    return BlurWidths(FormationConf(widths=of, lr=lr, prior=prior), [LOW, OTHER])


def teach(blur: BlurWidths, view: LoadedView, render: Tensor, photograph: Tensor) -> None:
    """Take a step on a view with this render and photograph."""
    step, factor = Step(0, 100, view), render.shape[0] // photograph.shape[0]
    variances = blur.variances(step, factor)
    formed = resize(render, *photograph.shape[:2], variances=variances)
    torch.autograd.backward((formed - photograph).square().mean())
    blur.learn(step)


def fine_image(height: int, width: int) -> Tensor:
    """Noise with the falling spectrum of photographs."""
    image = noise(height, width, 5).numpy()
    octaves = [gaussian_filter(image, (s, s, 0), mode="wrap") * s for s in (1, 2, 4, 8)]
    return torch.from_numpy(np.sum(octaves, axis=0))


def taken(image: Tensor, down: float, across: float) -> Tensor:
    """A photograph of an image that is 5 times as fine: blurred, then averaged over its pixels."""
    blurred = gaussian_filter(image.numpy(), (5 * down, 5 * across, 0), mode="reflect")
    height, width = (size // 5 for size in image.shape[:2])
    return torch.from_numpy(blurred.reshape(height, 5, width, 5, 3).mean(axis=(1, 3)))


def found(render: Tensor, photograph: Tensor) -> tuple[float, float]:
    """The widths, down and across, that fit the photograph best."""
    blur = widths(lr=0.05)
    for _ in range(150):
        teach(blur, LOW, render, photograph)
    return blur.of("low")


@pytest.mark.parametrize(("down", "across"), [(0.8, 0.8), (0.8, 1.5)])
def test_the_variances_of_a_blur_and_of_the_box_of_a_pixel_add_up(
    down: float, across: float
) -> None:
    """Bicubic resampling damps the highest frequencies too, so that a little less is found."""
    render = fine_image(200, 240)
    expected = math.hypot(down, BOX), math.hypot(across, BOX)
    assert found(render, taken(render, down, across)) == pytest.approx(expected, rel=0.04)


def test_the_widths_that_fit_best_are_those_of_the_photograph() -> None:
    render, truth = fine_image(100, 120), (0.85, 0.4)
    variances = (5 * torch.tensor(truth, dtype=torch.float64)).square()
    photograph = resize(render, 20, 24, variances=variances)
    assert found(render, photograph) == pytest.approx(truth, abs=1e-3)


def test_bicubic_resampling_is_enough_for_the_box_of_a_pixel() -> None:
    render = fine_image(100, 120)
    assert max(found(render, taken(render, 0.0, 0.0))) < 0.15


def test_a_render_is_blurred_by_a_width_in_pixels_of_the_photograph(
    build: Build, on: ComponentsConf, lr: Step
) -> None:
    parts, render = build(on), noise(24, 30, 3)
    variances = torch.full((2,), 4 / 12, dtype=torch.float64)
    expected = resize(render, 12, 15, variances=variances)
    torch.testing.assert_close(parts.to_photograph(render, lr), expected, rtol=0, atol=1e-12)
    assert lr.log == {
        "formation.sigma_x": pytest.approx(BOX),
        "formation.sigma_y": pytest.approx(BOX),
    }
    # It works without supersampling too.
    on.supersampled.factor = on.supersampled.late_factor = 1
    parts, render = build(on), noise(12, 15, 3)
    assert parts.render_camera(lr.view.camera, lr).width == 15
    expected = resize(render, 12, 15, variances=torch.full((2,), 1 / 12, dtype=torch.float64))
    torch.testing.assert_close(parts.to_photograph(render, lr), expected, rtol=0, atol=1e-12)


def test_hr_views_are_untouched(
    build: Build, on: ComponentsConf, hr: Step, gaussians: Gaussians
) -> None:
    parts, image = build(on), noise(60, 75, 3).requires_grad_()
    assert parts.to_photograph(image, hr) is image
    before = parts.state_dict()["0.Supersampled"]["values"].clone()
    parts.after_backward(gaussians, hr)
    assert torch.equal(parts.state_dict()["0.Supersampled"]["values"], before)
    assert hr.log == {}


def test_an_update_is_adams_on_the_loss_with_its_prior() -> None:
    render, blur = noise(24, 30, 3), widths(lr=0.02, prior=0.1)
    photograph = resize(render, 12, 15, variances=torch.tensor([2.0, 9.0]).double())
    logs = torch.full((2,), math.log(BOX), dtype=torch.float64, requires_grad=True)
    adam = torch.optim.Adam([logs], lr=0.02)
    for _ in range(5):
        teach(blur, LOW, render, photograph)
        adam.zero_grad()
        formed = resize(render, 12, 15, variances=(2 * logs.exp()).square())
        loss = (formed - photograph).square().mean()
        loss = loss + 0.1 * (logs - math.log(BOX)).square().sum()
        torch.autograd.backward(loss)
        adam.step()
        torch.testing.assert_close(blur.values[0], logs.detach(), atol=1e-6, rtol=0)
    assert blur.of("low") == blur.of("other")


def test_each_view_may_have_widths_of_its_own_and_learns_from_gradients() -> None:
    blur, render = widths("view"), noise(24, 30, 3)
    teach(blur, OTHER, render, resize(render, 12, 15))
    assert max(blur.of("other")) < 0.995 * BOX
    step = Step(0, 100, LOW)
    with torch.no_grad():
        assert not blur.variances(step, 2).requires_grad
    blur.learn(step)
    assert blur.of("low") == pytest.approx((BOX, BOX))
    assert step.log == {}


@pytest.mark.parametrize(
    ("of", "message"),
    [("tag", "0.30 px of blur across, 0.40 down"), ("view", "0.29 px of blur (other) to 0.35 px")],
)
def test_the_widths_are_said_at_the_end(of: str, message: str) -> None:
    blur = widths(of)
    blur.values[0] = torch.tensor([0.4, 0.3]).log()
    (found,) = blur.findings()
    assert f"LR views: {message}" in found
