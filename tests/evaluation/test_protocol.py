"""Scores and renders against the renderer and float64 formulas, for any number of threads."""

from __future__ import annotations

import math
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from xrgs.config import Conf, SplatConf
from xrgs.evaluation import protocol
from xrgs.splat.cameras import Camera
from xrgs.splat.gaussians import Gaussians
from xrgs.splat.rendering import rasterize_parameters
from xrgs.training.dataset import Dataset, LoadedView


@pytest.fixture
def gaussians(data: Dataset) -> Gaussians:
    """Gaussians whose colours depend on the view direction, by random SH of every degree."""
    generator = torch.Generator().manual_seed(0)
    made = Gaussians.from_points(
        data.points, data.colors, init_opacity=0.6, sh_degree=3, generator=generator
    )
    with torch.no_grad():
        made.shN += 0.3 * torch.randn(made.shN.shape, generator=generator)
    return made


@pytest.fixture
def view(data: Dataset) -> LoadedView:
    """A view of noise, large enough for torch to divide its sums among threads."""
    width, height = 240, 180
    noise = torch.rand(height, width, 3, generator=torch.Generator().manual_seed(1))
    K = torch.tensor([[width, 0.0, width / 2], [0.0, width, height / 2], [0.0, 0.0, 1.0]])
    return replace(data.test[0], camera=Camera(torch.eye(4), K, width, height), pixels=noise)


def test_scores_and_pngs_are_of_the_render_with_all_sh_degrees(
    gaussians: Gaussians, data: Dataset, baseline: Conf, tmp_path: Path
) -> None:
    conf = baseline.splat
    renders = tmp_path / "renders"
    (row,) = protocol.score_views(gaussians, data.test, conf, renders)
    view = data.test[0]
    images = {}
    with torch.no_grad():
        for degree in (0, 3):
            render = rasterize_parameters(
                *gaussians.activated(), view.camera, conf.raster, sh_degree=degree, backend="torch"
            )
            images[degree] = render.image.double().numpy().clip(0, 1)
    assert np.abs(images[3] - images[0]).mean() > 0.01
    error = ((images[3] - view.image.double().numpy()) ** 2).mean()
    assert row["view"] == view.name
    assert row["psnr"] == pytest.approx(10 * math.log10(1 / error), rel=1e-6)
    assert row["lpips"] is None
    png = np.asarray(Image.open(tmp_path / "renders" / f"{view.name}.png"), dtype=float) / 255
    assert np.abs(png - images[3]).max() <= 0.5 / 255 + 1e-6


def test_scores_are_the_same_for_any_number_of_threads(
    gaussians: Gaussians, view: LoadedView, baseline: Conf, tmp_path: Path
) -> None:
    scores = []
    for threads in (1, 3):
        torch.set_num_threads(threads)
        renders = tmp_path / str(threads)
        scores += protocol.score_views(gaussians, [view], baseline.splat, renders)
        assert torch.get_num_threads() == threads
    torch.set_num_threads(1)
    assert scores[0]["psnr"] > 1
    assert scores[0] == scores[1]


def test_means_are_those_of_the_views(
    gaussians: Gaussians, data: Dataset, baseline: Conf, tmp_path: Path
) -> None:
    views = (*data.test, *data.train)
    rows = protocol.score_views(gaussians, views, baseline.splat, tmp_path / "r")
    means = protocol.mean_scores(gaussians, views, baseline.splat)
    assert len(rows) > 1
    for name in ("psnr", "ssim"):
        assert means[name] == pytest.approx(np.mean([row[name] for row in rows]), rel=1e-12)
    assert means["lpips"] is None


def test_render_time_is_the_median_of_renders_after_the_first_of_each_view(
    gaussians: Gaussians, data: Dataset, baseline: Conf, monkeypatch: pytest.MonkeyPatch
) -> None:
    seconds = {"a": [9.0, 0.004], "b": [0.001, 0.5], "c": [7.0, 0.006]}
    clock = [0.0]

    def render(of: Gaussians, view: LoadedView, conf: SplatConf) -> None:
        assert (of, conf) == (gaussians, baseline.splat)
        clock[0] += seconds[view.name].pop(0)

    monkeypatch.setattr(protocol, "_render", render)
    monkeypatch.setattr(time, "perf_counter", lambda: clock[0])
    views = [replace(data.test[0], name=name) for name in seconds]
    time_ms = protocol.render_time(gaussians, views, baseline.splat)
    assert time_ms == pytest.approx(6.0)
    assert seconds == {name: [] for name in "abc"}, "each view is rendered twice"
