"""Scores by several training views: the high errors, or the edges, that a Gaussian shows."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.ndimage import correlate
from torch import Tensor

from examples.arms.tests.conftest import with_arms
from tests.training.components.conftest import renderer_of
from xrgs.config import ComponentsConf
from xrgs.errors import XrgsError
from xrgs.splat.gaussians import ActivatedGaussians, Gaussians
from xrgs.splat.rendering import attribute_pixels, rasterize_parameters
from xrgs.splat.settings import RasterSettings
from xrgs.splat.strategy.mcmc import MCMCStrategy
from xrgs.training.components import Components, Step
from xrgs.training.dataset import Dataset, LoadedView
from xrgs.training.loop import train
from xrgs_arms.view_scores import ErrorScore, edges

Build = Callable[..., Components]
Scores = Callable[..., Tensor]


@pytest.fixture
def fine(views: dict[str, LoadedView]) -> list[LoadedView]:
    """The HR view, and the LR view with its sampling rate."""
    return [views["HR"], replace(views["LR"], sampling_rate=0.2)]


def ready(parts: Components) -> Components:
    parts.before_training(renderer_of(parts))
    return parts


def attributed(pixels: Tensor, gaussians: Gaussians, view: LoadedView) -> Tensor:
    settings = RasterSettings()
    return attribute_pixels(pixels, gaussians.activated(), view.camera, settings).sums


def image_of(gaussians: ActivatedGaussians, view: LoadedView) -> Tensor:
    return rasterize_parameters(*gaussians, view.camera, RasterSettings(), sh_degree=0).image


def test_a_gaussian_may_grow_where_it_shows_enough_high_errors(
    build: Build, off: ComponentsConf, hr: Step, shown: Gaussians, fine: list[LoadedView]
) -> None:
    off.plugins["multiview_score"] = settings = {"views": 2, "error": 0.7}
    expected = torch.zeros(8, dtype=torch.float64)
    for view, area in zip(fine, (1, 25), strict=True):
        error = (image_of(shown.activated(), view) - view.image).abs().mean(dim=-1)
        high = (error - error.min()) / (error.max() - error.min()) > 0.7
        assert 5 < high.sum() < high.numel() / 2
        expected += area * attributed(high.double(), shown, view) / 2
    settings["pixels"] = expected.median().item() * (1 + 1e-9)
    grows = ready(build(off, *fine)).may_grow(shown, hr)
    assert grows is not None
    assert torch.equal(grows, expected > expected.median())
    assert grows.sum() == 4


def edges_in_scipy(image: Tensor) -> Tensor:
    kernel = np.full((3, 3), -1.0)
    kernel[1, 1] = 8
    return torch.from_numpy(np.abs(correlate(image.sum(dim=-1).numpy(), kernel, mode="nearest")))


@pytest.mark.parametrize("of", ["edges", "errors"])
def test_what_grows_is_ranked_by_edges_or_errors(
    build: Build, off: ComponentsConf, hr: Step, shown: Gaussians, fine: list[LoadedView], of: str
) -> None:
    off.plugins["error_score"] = {"of": of, "views": 5}
    expected = torch.zeros(8, dtype=torch.float64)
    for view in fine:
        pixels = (image_of(shown.activated(), view) - view.image).abs().mean(dim=-1)
        if of == "edges":
            laplacian = edges_in_scipy(view.image)
            torch.testing.assert_close(edges(view.image), laplacian)
            pixels = (laplacian - laplacian.min()) / (laplacian.max() - laplacian.min())
        sums = attributed(pixels, shown, view)
        expected += sums / sums[sums > 0].mean() / 2
    scores = ready(build(off, *fine)).growth_scores(shown, hr)
    assert scores is not None
    torch.testing.assert_close(scores, expected)
    assert scores.std() > 0.1


def test_the_work_counts_as_the_runs(data: Dataset) -> None:
    every_third_step = ("train.steps=20", "splat.backend=auto", "splat.densify.every=5000")
    over = (*every_third_step, "splat.densify.grow_grad2d=1")  # nothing grows
    plain = train(data, with_arms(*over))
    scored = train(data, with_arms(*over, "+ablation=multiview_score"))
    assert len(scored.gaussians) == len(plain.gaussians)
    # Refinements at steps 3, 6 and 9 render each of the four views twice.
    assert 1.5 * plain.evaluations < scored.evaluations < 3 * plain.evaluations


def test_views_follow_from_the_seed_and_the_step(
    build: Build, off: ComponentsConf, hr: Step, shown: Gaussians, fine: list[LoadedView]
) -> None:
    off.plugins["error_score"] = {"of": "edges", "views": 1}
    many = [replace(fine[i % 2], name=f"v{i}") for i in range(6)]
    for index, view in enumerate(many):
        view.image[0, 0] = index / 6
    (score,) = ready(build(off, *many))
    assert isinstance(score, ErrorScore)
    first, second, third, again = (
        score.growth_scores(shown, replace(hr, number=number)) for number in (600, 700, 800, 600)
    )
    assert torch.equal(first, again)
    assert not (torch.equal(first, second) and torch.equal(first, third))


@pytest.mark.parametrize(
    ("name", "setting"),
    [
        ("multiview_score", {"views": -1}),
        ("multiview_score", {"error": -0.1}),
        ("multiview_score", {"error": 1.0}),
        ("multiview_score", {"pixels": float("nan")}),
        ("error_score", {"views": 0}),
        ("error_score", {"of": "all"}),
    ],
)
def test_a_value_out_of_range_names_its_key(
    name: str, setting: dict[str, object], build: Build, off: ComponentsConf
) -> None:
    off.plugins[name] = ({"views": 2} if name == "multiview_score" else {"of": "edges"}) | setting
    ((key, value),) = setting.items()
    with pytest.raises(XrgsError, match=rf"^components\.plugins\.{name}\.{key}={value}"):
        build(off)


@pytest.mark.parametrize(
    ("name", "on", "off_"),
    [("multiview_score", {"views": 2}, {"views": 0}), ("error_score", {"of": "edges"}, {})],
)
def test_they_are_off_or_refused_by_a_strategy_that_draws_what_grows(
    name: str, on: dict[str, object], off_: dict[str, object], build: Build, off: ComponentsConf
) -> None:
    off.plugins[name] = off_
    assert build(off) == ()
    off.plugins[name] = on
    (component,) = parts = build(off)
    with pytest.raises(XrgsError, match=type(component).__name__):
        parts.check_strategy("mcmc", MCMCStrategy)
