"""Colour maps of photographs: against numpy, torch's Adam and finite differences."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.splat.scenes import noise
from tests.training.components.conftest import NO_GAUSSIANS, Build, make_view, renderer_of
from xrgs.config import ComponentsConf, ExposureConf
from xrgs.splat.gaussians import Gaussians
from xrgs.training.components import Step
from xrgs.training.components.exposure import Exposure, apply_map
from xrgs.training.dataset import LoadedView


@pytest.fixture
def on(off: ComponentsConf) -> ComponentsConf:
    off.exposure.mode = "affine"
    return off


def exposure(mode: str = "affine", count: int = 2, prior: float = 0.01) -> Exposure:
    """Of `count` HR views `h0`, `h1`, ... and one LR view `low`."""
    views = [make_view("HR", noise(12, 15, 0)) for _ in range(count)]
    views = [replace(view, name=f"h{i}") for i, view in enumerate(views)]
    views.append(replace(make_view("LR", noise(12, 15, 1)), name="low"))
    conf = ExposureConf(mode=mode, lr=0.02, lr_final=0.05, prior=prior)
    return Exposure(conf, views)


def on_view(name: str, number: int = 0) -> Step:
    view: LoadedView = replace(make_view("HR", noise(12, 15, 2)), name=name)
    return Step(number, 100, view)


def teach(component: Exposure, name: str, number: int = 0, brighter: float = 1.3) -> None:
    """Take a step on a view whose photograph is so many times as bright as the render."""
    step, render = on_view(name, number), noise(12, 15, 3)
    mapped = component.match_colors(render, step)
    torch.autograd.backward((mapped - brighter * render).square().mean())
    component.after_backward(NO_GAUSSIANS, step)


def test_a_map_is_a_matrix_and_an_offset() -> None:
    image, colors = noise(7, 5, 0), noise(3, 4, 1)[..., 0]
    expected = np.einsum("ij,hwj->hwi", colors[:, :3], image) + colors[:, 3].numpy()
    np.testing.assert_allclose(apply_map(image, colors), expected, rtol=1e-14)


def test_gradients_are_those_of_finite_differences() -> None:
    image, colors = noise(4, 5, 0).requires_grad_(), noise(3, 4, 1)[..., 0].requires_grad_()
    assert torch.autograd.gradcheck(apply_map, (image, colors))


@pytest.mark.parametrize("mode", ["affine", "gain"])
def test_an_update_is_adams_on_the_loss_with_its_prior(mode: str) -> None:
    """Of an LR view, which the mean over HR views leaves alone."""
    component, render = exposure(mode, prior=0.1), noise(12, 15, 3)
    learned = torch.eye(3, 4).double() if mode == "gain" else torch.ones(3, 4).double()
    deviation = torch.zeros(3, 4, dtype=torch.float64, requires_grad=True)
    adam = torch.optim.Adam([deviation], lr=0.02)
    for number in (0, 3, 10, 50):
        teach(component, "low", number)
        adam.zero_grad()
        mapped = apply_map(render, torch.eye(3, 4).double() + deviation * learned)
        loss = (mapped - 1.3 * render).square().mean() + 0.1 * deviation.square().sum()
        torch.autograd.backward(loss)
        adam.param_groups[0]["lr"] = 0.02 * 0.05 ** (number / 100)
        adam.step()
        expected = torch.eye(3, 4).double() + deviation * learned
        torch.testing.assert_close(component.map_of("low").double(), expected, atol=1e-6, rtol=0)
    gain = component.map_of("low")[:, :3].sum(dim=1)
    assert (gain > 1.02).all()


@pytest.mark.parametrize("count", [1, 5])
def test_the_mean_map_of_the_hr_views_is_the_identity(count: int) -> None:
    component = exposure(count=count)
    for number, name in enumerate(component.names * 2):
        teach(component, name, number, brighter=1 + 0.1 * number)
        mean = torch.stack([component.map_of(name) for name in component.names[:-1]]).mean(dim=0)
        torch.testing.assert_close(mean, torch.eye(3, 4), atol=1e-6, rtol=0)
    assert not torch.allclose(component.map_of("low"), torch.eye(3, 4), atol=1e-3)
    if count == 1:
        assert torch.equal(component.map_of("h0"), torch.eye(3, 4))
    low = [replace(make_view("LR", noise(12, 15, 1)), name=name) for name in ("a", "b")]
    component = Exposure(component.settings, low)  # without HR views the mean is over all
    teach(component, "a")
    total = component.map_of("a") + component.map_of("b")
    torch.testing.assert_close(total, 2 * torch.eye(3, 4))
    assert not torch.equal(component.map_of("a"), torch.eye(3, 4))


def test_a_render_without_gradients_teaches_nothing() -> None:
    component, step = exposure(), on_view("low")
    with torch.no_grad():
        component.match_colors(noise(12, 15, 3), on_view("h0"))
    component.after_backward(NO_GAUSSIANS, step)
    assert torch.equal(component.map_of("low"), torch.eye(3, 4))
    assert step.log == {}


@pytest.mark.parametrize("tag", ["HR", "LR"])
def test_all_that_compares_colours_sees_them_as_the_photograph_has_them(
    build: Build, on: ComponentsConf, views: dict[str, LoadedView], shown: Gaussians, tag: str
) -> None:
    """A photograph that is a render in other colours has no loss under its own map."""
    on.consistency.weight = 1.0
    on.supersampled.factor = on.supersampled.late_factor = 2
    colors = torch.eye(3, 4) + 0.2 * torch.randn(3, 4, generator=torch.Generator().manual_seed(6))
    render = renderer_of(build(on)).photograph(shown, Step(0, 100, views[tag]))
    image = torch.einsum("ij,hwj->hwi", colors[:, :3].double(), render) + colors[:, 3]
    views[tag] = replace(views[tag], pixels=image)
    parts = build(on, *views.values())
    (component,) = (part for part in parts if isinstance(part, Exposure))
    for learned in (True, False):
        step = Step(0, 100, views[tag])
        component.deviations.values[:] = (colors - torch.eye(3, 4)) * learned
        mapped = renderer_of(parts).photograph(shown, step)
        assert ((mapped - image).abs().max() < 1e-6) == learned
        loss = parts.modify_loss(torch.zeros(()).double(), mapped, shown, step).item()
        assert (loss < 1e-5) if learned else (loss > 0.01)


def test_the_gain_is_recorded_and_its_extremes_are_named() -> None:
    component, step = exposure(), on_view("low")
    component.deviations.values[2, :, :3] = torch.tensor([[0.2, 0, 0], [0, 0.3, 0.1], [0, 0, 0]])
    component.deviations.values[0] = -0.1 * torch.eye(3, 4)
    component.match_colors(noise(12, 15, 3), step)
    assert step.log["exposure.gain"] == pytest.approx(1.2)
    (found,) = component.findings()
    assert found.endswith("0.900 (h0) to 1.200 (low)")
