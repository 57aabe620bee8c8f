"""HR views are small at first, by how much of their spectra a factor keeps; LR views are not."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch.nn.functional import interpolate

from tests.splat.scenes import noise
from tests.training.components.conftest import Build
from xrgs.config import ComponentsConf
from xrgs.errors import XrgsError
from xrgs.training.components import Components, Step, TrainingView
from xrgs.training.components.resolution_schedule import ResolutionSchedule, kept_shares


@pytest.fixture
def on(off: ComponentsConf) -> ComponentsConf:
    off.resolution_schedule.start_share = 0.25
    return off


def _component(parts: Components) -> ResolutionSchedule:
    (component,) = parts
    assert isinstance(component, ResolutionSchedule)
    return component


def _views(parts: Components, *steps: Step) -> TrainingView:
    """The view of the last step, after training has asked for those of all steps."""
    for step in steps:
        views = parts.training_views({s.view.name: s.view for s in steps}, step)
    return views[step.view.name]


def test_waves_are_kept_up_to_their_frequency() -> None:
    """Cosines of amplitude a have two lines of magnitude a / 2 times the number of pixels."""
    x, y = torch.arange(48, dtype=torch.float64), torch.arange(96, dtype=torch.float64)
    waves = [(3.0, 0.0, 0.0), (1.0, 0.125, 0.0), (0.5, 0.0, 0.25), (0.25, 0.125, 0.375)]
    image = torch.zeros(96, 48, dtype=torch.float64)
    for amplitude, fx, fy in waves:
        image += amplitude * torch.cos(2 * math.pi * (fx * x + fy * y[:, None]))
    shares = kept_shares([image[..., None].expand(-1, -1, 3)], [1, 2, 3, 4, 8])
    # A constant has one line, and a highest frequency of 1 / (2 factor) is kept.
    expected = {1: 1.0, 2: 4.5 / 4.75, 3: 4 / 4.75, 4: 4 / 4.75, 8: 3 / 4.75}
    assert shares == pytest.approx(expected, abs=1e-6)


def test_images_add_their_magnitudes() -> None:
    images = [noise(20, 30, 0), noise(15, 11, 1)]
    kept = total = 0.0
    for image in images:
        spectrum = np.fft.fftshift(np.abs(np.fft.fft2(image.numpy(), axes=(0, 1))), axes=(0, 1))
        height, width = image.shape[:2]
        (top, left), (h, w) = (height // 2, width // 2), (height // 4, width // 4)
        kept += spectrum[top - h : top + h + 1, left - w : left + w + 1].sum()
        total += spectrum.sum()
    assert kept_shares(images, [2]) == pytest.approx({2: kept / total}, abs=1e-6)
    assert kept_shares([torch.zeros(12, 12, 3)], [1, 8]) == {1: 1.0, 8: 1.0}


def test_the_factor_falls_as_the_share_that_is_needed_rises(
    build: Build, on: ComponentsConf, hr: Step, lr: Step
) -> None:
    component = _component(build(on))
    assert list(component.kept) == [1, 2, 3, 4, 5]  # of 60 px, the window of SSIM and more
    # 0.25^(1 - t / 15,000) is 1 / 3 at t = 3,113 and 1 / 2 at t = 7,500.
    component.kept = {1: 1.0, 2: 0.5, 3: 1 / 3, 4: 1 / 3}
    factors = {0: 4, 3112: 4, 3114: 2, 7499: 2, 7501: 1, 15_000: 1, 29_999: 1}
    for number, factor in factors.items():
        assert component.factor_at(replace(hr, number=number)) == factor
    assert component.factor_at(replace(hr, number=1038, total=10_000)) == 2
    with pytest.raises(XrgsError, match="no HR view"):
        build(on, lr.view)


def test_an_hr_view_is_made_smaller_and_shows_the_same(
    build: Build, on: ComponentsConf, hr: Step, lr: Step
) -> None:
    parts = build(on)
    _component(parts).kept = {1: 1.0, 2: 0.9, 4: 0.1}
    view = _views(parts, lr, hr)
    assert (view.camera.width, view.camera.height) == (38, 30)
    batch = hr.view.image.movedim(-1, 0)[None]
    small = interpolate(batch, (30, 38), mode="bicubic", antialias=True)[0].movedim(0, -1)
    torch.testing.assert_close(view.image, small, rtol=0, atol=1e-12)
    point = torch.tensor([0.3, -0.2, 2.0])
    ours, full = ((c.K @ point)[:2] / point[2] for c in (view.camera, hr.view.camera))
    torch.testing.assert_close(ours, full * torch.tensor([38 / 75, 0.5]))
    assert (view.name, view.tag, view.sampling_rate) == (hr.view.name, "HR", hr.view.sampling_rate)
    assert hr.log == {"resolution_schedule.factor": 2}
    assert _views(parts, hr, lr) is lr.view
    assert lr.log == {}


def test_views_are_made_once_for_each_factor(
    build: Build, on: ComponentsConf, hr: Step, lr: Step
) -> None:
    parts, own = build(on), {"hr": hr.view, "lr": lr.view}
    _component(parts).kept = {1: 1.0, 2: 0.5, 3: 0.4, 4: 0.3}
    at = {n: parts.training_views(own, replace(hr, number=n)) for n in (0, 1, 4000, 7000, 9000)}
    assert at[0] is at[1]
    assert [views["hr"].camera.width for views in at.values()] == [19, 19, 25, 38, 75]
    assert at[9000] is own
    assert _component(parts).reduced == {}  # nothing is held that is no longer used
