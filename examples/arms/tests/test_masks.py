"""Pixels outside a mask change nothing in the arms."""

from __future__ import annotations

from pathlib import Path

import torch

from examples.arms.tests.conftest import with_arms
from tests.training.conftest import comparable
from tests.training.test_masks import frozen
from xrgs.training import dataset
from xrgs.training.loop import train
from xrgs_arms.view_scores import _in_unit_range


def test_hidden_pixels_change_no_bit_of_training(tmp_path: Path, backend: str) -> None:
    conf = with_arms(
        f"splat.backend={backend}",
        *("train.steps=9", "splat.densify.start=0", "splat.densify.every=10000"),
        *("splat.densify.grow_grad2d=1e-4", "splat.densify.budget=0.05"),
        "+ablation=[multiview_score,error_score,noise_weighting,skip_backward,near_gradients]",
        "components.plugins.multiview_score.views=2",
    )
    results = [train(dataset.load(frozen(tmp_path / str(seed), seed)), conf) for seed in (1, 2)]
    assert len(results[0].gaussians) != 80  # densification took part
    assert comparable(results[0]) == comparable(results[1])


def test_scores_are_scaled_by_the_used_pixels_and_0_outside() -> None:
    values = torch.tensor([[1.0, 2.0, 9.0], [3.0, 5.0, -4.0]])
    mask = torch.tensor([[True, True, False], [True, True, False]])
    expected = torch.tensor([[0.0, 0.25, 0.0], [0.5, 1.0, 0.0]])
    assert torch.equal(_in_unit_range(values, mask), expected)
