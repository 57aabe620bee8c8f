"""What the steps of a training rendered and left out."""

from __future__ import annotations

import dataclasses

import pytest
import torch

from xrgs.config import Conf
from xrgs.splat.gaussians import from_points
from xrgs.splat.rendering import Render
from xrgs.training import components, loop
from xrgs.training.components import Step
from xrgs.training.dataset import Dataset
from xrgs.training.work import StepWork


def test_a_step_is_counted_by_its_render_and_its_photograph(data: Dataset) -> None:
    generator = torch.Generator().manual_seed(0)
    points, colors = torch.rand(7, 3, generator=generator), torch.rand(7, 3, generator=generator)
    gaussians = from_points(points, colors, init_opacity=0.1, sh_degree=2, generator=generator)
    view = data.train[0]
    width, height = view.camera.width, view.camera.height
    visible = torch.tensor([True, False, True, True, False, True, True])
    work = StepWork(data.train)
    # A component has replaced the view by a smaller one; the photograph is the one of the dataset.
    replaced = dataclasses.replace(view, camera=view.camera.resized(4, 3))
    smaller = Render(torch.empty(3, 4, 3), torch.empty(3, 4), visible, 50, 0, tile_evaluations=60)
    larger = Render(torch.empty(99, 98, 3), torch.empty(99, 98), visible, 1, 0, tile_evaluations=2)
    work.add(Step(0, 2, replaced), smaller, gaussians, sh_degree=1)
    work.add(Step(1, 2, view), larger, gaussians, sh_degree=2)
    restored = StepWork(data.train)
    restored.load_state_dict(work.state_dict())
    assert (
        restored.totals()
        == work.totals()
        == {
            "views": 1,
            "gaussians": 2 * 7,
            "gaussians_visible": 2 * 5,
            "pixels": 12 + 99 * 98,
            "pixels_photograph": 2 * width * height,
            "pixels_left_out": width * height - 12,
            "pairs": 7 * (12 + 99 * 98),
            "pairs_visible": 5 * (12 + 99 * 98),
            "pairs_in_tiles": 62,
            "sh_coefficients": 2 * 5 * 9,
            "sh_coefficients_left_out": 5 * 5,  # band 2
        }
    )


def test_training_counts_every_step(data: Dataset, short: Conf) -> None:
    """Against what a component sees of each step, and what the history says of it."""
    pixels = []

    class Watching(components.Component):
        def modify_loss(
            self, loss: torch.Tensor, image: torch.Tensor, gaussians: object, step: Step
        ) -> torch.Tensor:
            pixels.append(image.shape[0] * image.shape[1])
            return loss

    result = loop.train(data, short, extra_components=[Watching()])
    rows = result.history  # 40 steps have a row each
    assert result.work["views"] == len({row["view"] for row in rows})
    assert result.work["gaussians"] == sum(row["gaussians"] for row in rows)
    assert result.work["pixels"] == result.work["pixels_photograph"] == sum(pixels)
    assert result.work["pixels_left_out"] == 0
    pairs = sum(row["gaussians"] * size for row, size in zip(rows, pixels, strict=True))
    assert result.work["pairs"] == pairs
    assert 0 < result.work["gaussians_visible"] <= result.work["gaussians"]
    assert result.evaluations <= result.work["pairs_in_tiles"]
    assert sum(result.stage_seconds.values()) == pytest.approx(result.seconds, rel=0.05)
    assert set(result.stage_seconds) == {"forward", "backward", "optimizer", "densification"}
