"""Coarse views are rendered larger and brought down as their photographs were, and no others.

The learned blur of LR photographs is against a known blur, torch's Adam and scipy.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter
from torch import Tensor
from torch.nn.functional import avg_pool2d, interpolate

from tests.splat.scenes import noise
from tests.training.components.conftest import Build, make_view
from xrgs.config import ComponentsConf, Conf, FormationConf
from xrgs.splat.gaussians import Gaussians
from xrgs.splat.resample import resize
from xrgs.training import components
from xrgs.training.components import Components, Step
from xrgs.training.components.supersampled import BOX, BlurWidths
from xrgs.training.dataset import Dataset, LoadedView

LOW = replace(make_view("LR", noise(12, 15, 1)), name="low")
OTHER = replace(make_view("LR", noise(12, 15, 2)), name="other")


@pytest.fixture
def on(off: ComponentsConf) -> ComponentsConf:
    off.supersampled.factor = off.supersampled.late_factor = 2
    return off


def _bicubic(image: Tensor, height: int, width: int) -> Tensor:
    batch = image.movedim(-1, 0)[None]
    return interpolate(batch, (height, width), mode="bicubic", antialias=True)[0].movedim(0, -1)


def _built(
    conf: ComponentsConf, baseline: Conf, degradation: str, *views: LoadedView
) -> Components:
    points = torch.ones(2, 3)
    data = Dataset(views, (), points, points, 1.0, 5, degradation)
    return components.build(conf, data, baseline.splat)


def test_an_lr_view_is_rendered_twice_as_large_and_shows_the_same(
    build: Build, on: ComponentsConf, lr: Step
) -> None:
    camera = build(on).render_camera(lr.view.camera, lr)
    assert (camera.width, camera.height) == (30, 24)
    point = torch.tensor([[0.3, -0.2, 2.0], [-0.1, 0.4, 1.5]])
    small, large = ((c.K @ point.T)[:2] / point.T[2] for c in (lr.view.camera, camera))
    torch.testing.assert_close(large, 2 * small)  # pixel centres are at +0.5 in both
    assert lr.log == {"supersampled.factor": 2}
    # It is brought down by the kernel that made the photograph.
    render = noise(24, 30, 3)
    torch.testing.assert_close(
        build(on).to_photograph(render, lr), _bicubic(render, 12, 15), rtol=0, atol=1e-12
    )


def test_a_zoomed_view_is_brought_down_to_what_it_resolves_and_up_again(
    on: ComponentsConf, baseline: Conf
) -> None:
    view = make_view("LR", noise(60, 75, 1))
    parts, step = _built(on, baseline, "digital_zoom", view), Step(0, 1, view)
    camera = parts.render_camera(view.camera, step)
    assert (camera.width, camera.height) == (30, 24)
    render = noise(24, 30, 3)
    expected = _bicubic(_bicubic(render, 12, 15), 60, 75)
    torch.testing.assert_close(parts.to_photograph(render, step), expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    ("need", "early", "late", "tag"),
    [(0.6, 1, 1, "LR"), (1.4, 1, 1, "HR"), (1.6, 2, 2, "HR"), (3.4, 2, 3, "LR"), (9.0, 2, 5, "LR")],
)
def test_a_view_is_rendered_larger_by_its_need_and_not_by_its_tag(
    on: ComponentsConf, baseline: Conf, tag: str, need: float, early: int, late: int
) -> None:
    on.supersampled.late_factor, on.supersampled.late_from = 5, 15_000
    view = replace(make_view(tag, noise(12, 15, 1)), supersampling=need)
    parts = _built(on, baseline, "none", view)
    for number, factor in ((0, early), (14_999, early), (15_000, late)):
        step = Step(number, 30_000, view)
        camera = parts.render_camera(view.camera, step)
        assert (camera.width, camera.height) == (15 * factor, 12 * factor)
        assert step.log == ({"supersampled.factor": factor} if factor > 1 else {})
        render = noise(camera.height, camera.width, 3)
        photograph = parts.to_photograph(render, step)
        pooled = avg_pool2d(render.movedim(-1, 0), factor).movedim(0, -1)
        torch.testing.assert_close(photograph, pooled, rtol=0, atol=1e-12)
        assert factor > 1 or photograph is render


def test_a_coarse_hr_view_beside_degraded_ones_averages_over_its_pixels(
    on: ComponentsConf, baseline: Conf
) -> None:
    """No kernel of the variant has made it; nor does it resolve less than its pixels."""
    view = replace(make_view("HR", noise(12, 15, 1)), supersampling=2.0)
    for degradation in ("downsample", "digital_zoom"):
        parts, step = _built(on, baseline, degradation, view), Step(0, 1, view)
        assert parts.render_camera(view.camera, step).width == 30
        render = noise(24, 30, 3)
        pooled = avg_pool2d(render.movedim(-1, 0), 2).movedim(0, -1)
        torch.testing.assert_close(parts.to_photograph(render, step), pooled, rtol=0, atol=1e-12)


def test_the_number_of_views_with_each_factor_is_said(on: ComponentsConf, baseline: Conf) -> None:
    needs = (1.0, 1.2, 2.0, 4.8)
    views = [
        replace(make_view("LR", torch.zeros(12, 15, 3)), name=f"{need}", supersampling=need)
        for need in needs
    ]
    on.supersampled.late_factor, on.supersampled.late_from = 5, 22_000
    found = _built(on, baseline, "none", *views).findings()
    assert found == [
        "supersampled: views at k times their size: 2 at 1, 2 at 2;"
        " from step 22000 on 2 at 1, 1 at 2, 1 at 5"
    ]


@pytest.fixture
def blurred(off: ComponentsConf) -> ComponentsConf:
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


@pytest.mark.slow
def test_the_variances_of_a_blur_and_of_the_box_of_a_pixel_add_up() -> None:
    """Bicubic resampling damps the highest frequencies too, so that a little less is found."""
    render = fine_image(200, 240)
    expected = math.hypot(0.8, BOX), math.hypot(1.5, BOX)
    assert found(render, taken(render, 0.8, 1.5)) == pytest.approx(expected, rel=0.04)


def test_a_render_is_blurred_by_a_width_in_pixels_of_the_photograph(
    build: Build, blurred: ComponentsConf, lr: Step
) -> None:
    parts, render = build(blurred), noise(24, 30, 3)
    variances = torch.full((2,), 4 / 12, dtype=torch.float64)
    expected = resize(render, 12, 15, variances=variances)
    torch.testing.assert_close(parts.to_photograph(render, lr), expected, rtol=0, atol=1e-12)
    assert lr.log == {
        "formation.sigma_x": pytest.approx(BOX),
        "formation.sigma_y": pytest.approx(BOX),
    }
    # It works without supersampling too.
    blurred.supersampled.factor = blurred.supersampled.late_factor = 1
    parts, render = build(blurred), noise(12, 15, 3)
    assert parts.render_camera(lr.view.camera, lr).width == 15
    expected = resize(render, 12, 15, variances=torch.full((2,), 1 / 12, dtype=torch.float64))
    torch.testing.assert_close(parts.to_photograph(render, lr), expected, rtol=0, atol=1e-12)


def test_hr_views_are_untouched(
    build: Build, blurred: ComponentsConf, hr: Step, gaussians: Gaussians
) -> None:
    parts, image = build(blurred), noise(60, 75, 3).requires_grad_()
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
