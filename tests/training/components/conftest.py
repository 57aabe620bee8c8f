"""A step on an HR view and one on an LR view, and the components of a config."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from tests.splat.scenes import noise
from xrgs.config import ComponentsConf, Conf
from xrgs.splat.cameras import Camera
from xrgs.splat.gaussians import PARAMETERS, Gaussians
from xrgs.splat.settings import RasterSettings
from xrgs.training import components
from xrgs.training.components import Components, Step
from xrgs.training.dataset import Dataset, LoadedView
from xrgs.training.recorder import TrainingRecorder
from xrgs.training.rendering import StepRenderer

FACTOR = 5

#: (config, *views) -> its components.
Build = Callable[..., Components]
#: For losses that do not depend on the Gaussians.
NO_GAUSSIANS = Gaussians(*[torch.empty(0)] * 6)


def make_view(tag: str, image: Tensor) -> LoadedView:
    """A view named as its tag in small letters."""
    height, width = image.shape[:2]
    K = torch.tensor([[1.2 * width, 0, width / 2], [0, 1.2 * width, height / 2], [0, 0, 1]])
    camera = Camera(torch.eye(4), K, width, height)
    return LoadedView(tag.lower(), tag, camera, image, supersampling=FACTOR if tag == "LR" else 1)


def renderer_of(parts: Components) -> StepRenderer:
    """Renders as training does, on the torch backend."""
    recorder = TrainingRecorder(30_000, 0.0, [])
    return StepRenderer(parts, RasterSettings(sh_degree=0), 1000, "torch", recorder)


@pytest.fixture
def views() -> dict[str, LoadedView]:
    """A view of each tag by its tag; the LR view is 5 times smaller."""
    both = (make_view("HR", noise(60, 75, 0)), make_view("LR", noise(12, 15, 1)))
    return {view.tag: view for view in both}


@pytest.fixture
def steps(views: dict[str, LoadedView]) -> dict[str, Step]:
    """The first step of 30,000, on a view of each tag."""
    return {tag: Step(0, 30_000, view) for tag, view in views.items()}


@pytest.fixture
def hr(steps: dict[str, Step]) -> Step:
    return steps["HR"]


@pytest.fixture
def lr(steps: dict[str, Step]) -> Step:
    return steps["LR"]


@pytest.fixture
def off(baseline: Conf) -> ComponentsConf:
    """Every component off, as in the baseline; a test switches on the one that it examines."""
    return baseline.components


@pytest.fixture
def build(baseline: Conf, views: dict[str, LoadedView]) -> Build:
    """The views are those of `hr` and `lr` if none is given."""

    def built(conf: ComponentsConf, *given: LoadedView) -> Components:
        points = torch.rand(50, 3, generator=torch.Generator().manual_seed(2)) + 1
        data = Dataset(given or tuple(views.values()), (), points, points, 1.0, FACTOR)
        return components.build(conf, data, baseline.splat)

    return built


def gaussians_with_gradients() -> Gaussians:
    """Six Gaussians with a gradient in every value."""
    shapes = {"means": (3,), "quats": (4,), "scales": (3,), "opacities": (), "sh0": (1, 3)}
    generator = torch.Generator().manual_seed(0)
    values = {
        name: torch.randn(6, *shapes.get(name, (3, 3)), generator=generator).requires_grad_()
        for name in PARAMETERS
    }
    for value in values.values():
        value.grad = torch.randn(value.shape, generator=generator)
    return Gaussians(**values)


@pytest.fixture
def gaussians() -> Gaussians:
    return gaussians_with_gradients()


@pytest.fixture
def shown() -> Gaussians:
    """Eight small Gaussians in front of the cameras of `views`, float64."""
    generator = torch.Generator().manual_seed(4)
    means = torch.rand(8, 3, generator=generator).double() * torch.tensor([1.4, 1.0, 0.5])
    values = {
        "means": means + torch.tensor([-0.7, -0.5, 2.0]),
        "quats": torch.randn(8, 4, generator=generator).double(),
        "scales": torch.rand(8, 3, generator=generator).double() - 3,
        "opacities": torch.randn(8, generator=generator).double() + 1,
        "sh0": torch.randn(8, 1, 3, generator=generator).double(),
        "shN": torch.zeros(8, 0, 3).double(),
    }
    return Gaussians(**values)
