"""A guard against floaters: what is removed."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor

from tests.splat.scenes import noise
from xrgs.config import FloatersConf
from xrgs.splat.cameras import Camera
from xrgs.splat.gaussians import Gaussians
from xrgs.splat.settings import DensifySettings
from xrgs.training.components import Step
from xrgs.training.components.floaters import Floaters
from xrgs.training.dataset import LoadedView

EVERY = 100
"""Steps between two removals in a run of 30,000."""


@pytest.fixture
def looking() -> list[LoadedView]:
    """Three views of the origin from around it, of other sizes, float64."""
    places = [(4.0, 0.0, 0.0), (0.0, 5.0, 1.0), (-3.0, -3.0, 2.0)]
    views = []
    for number, (place, width) in enumerate(zip(places, (40, 24, 32), strict=True)):
        camera = Camera.look_at(place, (0, 0, 0), width=width, height=30)
        camera = replace(camera, viewmat=camera.viewmat.double(), K=camera.K.double())
        views.append(LoadedView(f"v{number}", "HR", camera, noise(30, width, number)))
    return views


@pytest.fixture
def points() -> Tensor:
    """500 SfM points about the origin, some of them behind cameras or outside images."""
    generator = torch.Generator().manual_seed(7)
    return 1.5 * torch.randn(500, 3, generator=generator, dtype=torch.float64)


def gaussians_at(means: Tensor) -> Gaussians:
    """Gaussians with a gradient of 1 in every value."""
    count = len(means)
    shapes = {"quats": (4,), "scales": (3,), "opacities": (), "sh0": (1, 3), "shN": (2, 3)}
    values = {name: torch.zeros(count, *shape).double() for name, shape in shapes.items()}
    values["means"] = means.clone()
    for value in values.values():
        value.requires_grad_()
        value.grad = torch.ones_like(value)
    return Gaussians(**values)


def guard(views: list[LoadedView], points: Tensor, share: float) -> Floaters:
    return Floaters(FloatersConf(near_share=share), views, points, DensifySettings(every=EVERY))


def projected(points: Tensor, view: LoadedView) -> tuple[NDArray[Any], NDArray[Any]]:
    """Depths, and whether a point is before the camera and in its image, by its 3 x 4 matrix."""
    camera = view.camera
    inside_camera = (camera.viewmat[:3, :3] @ points.T).T + camera.viewmat[:3, 3]
    image = (camera.K @ inside_camera.T).T.numpy()
    with np.errstate(divide="ignore"):
        pixels = image[:, :2] / image[:, 2:]
    inside = ((pixels >= 0) & (pixels <= (camera.width, camera.height))).all(axis=1)
    return image[:, 2], inside & (image[:, 2] > 0)


def test_the_near_depth_is_of_the_points_in_the_image(
    looking: list[LoadedView], points: Tensor
) -> None:
    component = guard(looking, points, 1.0)
    for view in looking:
        depths, inside = projected(points, view)
        assert 50 < inside.sum() < 500
        near = np.quantile(depths[inside], 0.01, method="lower")
        assert component.near[view.name] == pytest.approx(near)
        assert depths[inside].min() < near


def test_what_is_closer_than_the_limit_to_any_view_is_removed(
    looking: list[LoadedView], points: Tensor
) -> None:
    component = guard(looking, points, 3.0)
    means = 10 * noise(40, 50, 5).reshape(-1, 3) - 5  # in a cube that has the cameras
    expected = np.zeros(len(means), np.bool_)
    for view in looking:
        depths, inside = projected(means, view)
        expected |= inside & (depths < 3.0 * component.near[view.name])
    removed = component.to_prune(gaussians_at(means), Step(EVERY, 30_000, looking[0]))
    assert removed is not None
    assert removed.tolist() == expected.tolist()
    assert 10 < expected.sum() < len(means) / 2


def test_gaussians_are_removed_at_refinements_and_at_the_end(
    looking: list[LoadedView], points: Tensor
) -> None:
    component, gaussians = guard(looking, points, 0.5), gaussians_at(points)
    steps = (Step(number, 3000, looking[0]) for number in range(3000))
    due = [step.number for step in steps if component.to_prune(gaussians, step) is not None]
    assert due == [*range(0, 3000, 10), 2999]


def test_a_view_without_points_in_its_image_removes_nothing(looking: list[LoadedView]) -> None:
    """All points are behind the only camera, and the Gaussians before it."""
    (view,) = looking[:1]
    behind, before = (torch.tensor([[x, 0.1, 0.1]] * 5).double() for x in (9.0, 3.9))
    removed = guard([view], behind, 1.0).to_prune(gaussians_at(before), Step(0, 30_000, view))
    assert removed is not None
    assert not removed.any()
