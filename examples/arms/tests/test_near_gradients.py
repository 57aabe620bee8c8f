"""Gradients of Gaussians close to a camera are reduced."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from tests.training.components.test_floaters import gaussians_at, looking, points, projected
from tests.training.conftest import comparable
from xrgs.config import ComponentsConf, Conf
from xrgs.errors import XrgsError
from xrgs.splat.gaussians import PARAMETERS
from xrgs.training.components import Components, Step
from xrgs.training.dataset import Dataset, LoadedView
from xrgs.training.loop import train
from xrgs_arms.near_gradients import NearGradients, Settings

__all__ = ["looking", "points"]


def test_the_median_is_of_the_points_in_the_image(
    looking: list[LoadedView], points: Tensor
) -> None:
    component = NearGradients(Settings(1.0), looking, points)
    for view in looking:
        depths, inside = projected(points, view)
        assert 50 < inside.sum() < 500
        median = np.quantile(depths[inside], 0.5, method="lower")
        assert component.median[view.name] == pytest.approx(median)


@pytest.mark.parametrize("tag", ["HR", "LR"])
def test_gradients_fall_with_the_square_of_the_depth(
    looking: list[LoadedView], points: Tensor, tag: str
) -> None:
    component, gaussians = NearGradients(Settings(0.9), looking, points), gaussians_at(points)
    step = Step(1, 30_000, replace(looking[1], tag=tag))
    unit = 0.9 * component.median["v1"]
    depths, _ = projected(points, looking[1])
    expected = torch.from_numpy(np.where(depths > 0, np.clip((depths / unit) ** 2, 0, 1), 1.0))
    assert 50 < (expected < 1).sum() < 450
    component.after_backward(gaussians, step)
    for name in PARAMETERS:
        gradient = gaussians[name].grad
        assert gradient is not None
        torch.testing.assert_close(
            gradient, expected.reshape(-1, *[1] * (gradient.ndim - 1)).expand_as(gradient)
        )
    of_densification = component.densification_grad2d(torch.ones(500, 2).double(), step)
    torch.testing.assert_close(of_densification, expected[:, None].expand(500, 2))
    assert step.log == {"near_gradients.near": (expected < 1).sum()}


def test_a_view_without_points_in_its_image_lessens_nothing(looking: list[LoadedView]) -> None:
    """All points are behind the only camera, and the Gaussians in front of it."""
    (view,) = looking[:1]
    behind, before = (torch.tensor([[x, 0.1, 0.1]] * 5).double() for x in (9.0, 3.9))
    gaussians = gaussians_at(before)
    NearGradients(Settings(1.0), [view], behind).after_backward(gaussians, Step(0, 30_000, view))
    for name in PARAMETERS:
        gradient = gaussians[name].grad
        assert gradient is not None
        assert (gradient == 1).all()


def test_where_nothing_is_close_no_bit_changes(data: Dataset, short: Conf) -> None:
    plain = comparable(train(data, short))
    short.components.plugins["near_gradients"] = {"share": 1e-3}
    guarded = comparable(train(data, short))
    for result in (plain, guarded):
        del result["columns"], result["memory_bytes"]
        for row in result["history"]:
            row.pop("near_gradients.near", None)
    assert guarded == plain


def test_a_share_is_checked_and_0_is_off(
    build: Callable[..., Components], off: ComponentsConf
) -> None:
    off.plugins["near_gradients"] = {"share": 0.0}
    assert build(off) == ()
    off.plugins["near_gradients"] = {"share": float("inf")}
    with pytest.raises(XrgsError, match=r"^components\.plugins\.near_gradients\.share=inf"):
        build(off)
