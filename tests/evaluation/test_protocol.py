"""Scores are what they are, on any machine."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from xrgs.capture.dataset import Dataset, LoadedView
from xrgs.config import Conf
from xrgs.evaluation import protocol
from xrgs.splat.cameras import Camera
from xrgs.splat.gaussians import from_points


@pytest.fixture
def view(data: Dataset) -> LoadedView:
    """A view of noise, large enough for torch to divide its sums among threads."""
    width, height = 400, 300
    noise = torch.rand(height, width, 3, generator=torch.Generator().manual_seed(1))
    K = torch.tensor([[width, 0.0, width / 2], [0.0, width, height / 2], [0.0, 0.0, 1.0]])
    return replace(data.test[0], camera=Camera(torch.eye(4), K, width, height), image=noise)


def test_scores_are_the_same_for_any_number_of_threads(
    data: Dataset, view: LoadedView, baseline: Conf, tmp_path: Path
) -> None:
    generator = torch.Generator().manual_seed(0)
    gaussians = from_points(
        data.points, data.colors, init_opacity=0.1, sh_degree=3, generator=generator
    )
    scores = []
    for threads in (1, 2, 3):
        torch.set_num_threads(threads)
        scores += protocol.score_views(gaussians, [view], baseline.splat, tmp_path / str(threads))
        assert torch.get_num_threads() == threads
    torch.set_num_threads(1)
    assert scores[0]["psnr"] > 1
    assert scores == [scores[0]] * 3
