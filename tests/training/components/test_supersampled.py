"""Coarse views are rendered larger and brought down as their photographs were, and no others."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, interpolate

from tests.splat.scenes import noise
from tests.training.components.conftest import Build, make_view
from xrgs.config import ComponentsConf, Conf
from xrgs.training import components
from xrgs.training.components import Components, Step
from xrgs.training.dataset import Dataset, LoadedView


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
