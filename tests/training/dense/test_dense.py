"""The dense start as training gets it: its gate, its bits, its time, and continued runs."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from tests.conftest import composed as compose
from tests.training.conftest import Losses, killed_and_not, same
from tests.training.dense.conftest import TrueScene
from xrgs.splat.backend import resolve_backend
from xrgs.splat.gaussians import Gaussians
from xrgs.training import dense
from xrgs.training.dataset import Dataset
from xrgs.training.loop import train

BACKEND = resolve_backend("auto")


def start(data: Dataset) -> tuple[Gaussians, Gaussians]:
    """The Gaussians on SfM points, and those that training starts from."""
    generator = torch.Generator().manual_seed(0)
    points = data.points, data.colors
    sparse = Gaussians.from_points(*points, init_opacity=0.1, sh_degree=3, generator=generator)
    return sparse, dense.dense_start(data, sparse, BACKEND, torch.Generator().manual_seed(1))


@pytest.mark.slow
def test_sfm_points_come_first_and_squares_fill_the_budget(
    scene: TrueScene, monkeypatch: pytest.MonkeyPatch
) -> None:
    sparse, first = start(scene.data)
    budget = round(dense.BUDGET * scene.data.view_pixels)
    assert len(sparse) + 0.99 * budget < len(first) <= len(sparse) + budget
    head, tail = slice(len(sparse)), slice(len(sparse), None)
    assert all(torch.equal(first[name][head], sparse[name]) for name in ("means", "scales", "sh0"))
    assert torch.sigmoid(first.opacities[tail]).sub(dense.OPACITY).abs().max() < 1e-6
    assert first.shN[tail].eq(0).all()
    assert all(first[name].requires_grad and first[name].is_leaf for name in ("means", "quats"))
    # They show the first view better than the SfM points do, before any training.
    monkeypatch.setattr(dense, "dense_start", lambda *_: first)
    losses = [
        train(scene.data, compose("train.steps=1", "splat.backend=auto", f"splat.init={init}"))
        for init in ("sfm", "dense")
    ]
    assert losses[1].history[0]["loss"] < 0.6 * losses[0].history[0]["loss"]


@pytest.mark.slow
def test_any_number_of_threads_gives_the_same_bits(scene: TrueScene) -> None:
    data = replace(scene.data, train=scene.data.train[:5])
    threads = torch.get_num_threads()
    try:
        starts = []
        for number in (1, 2):
            torch.set_num_threads(number)
            starts.append(start(data)[1])
    finally:
        torch.set_num_threads(threads)
    assert len(starts[0]) > len(data.points)
    assert same(*starts)


def noise(data: Dataset) -> Dataset:
    """Photographs that have nothing in common."""
    generator = torch.Generator().manual_seed(0)
    views = [
        replace(v, pixels=torch.randint(256, v.pixels.shape, generator=generator).byte())
        for v in data.train
    ]
    return replace(data, train=tuple(views))


def wrong_poses(data: Dataset) -> Dataset:
    """Each photograph with the pose of another."""
    views = data.train
    cameras = [views[(n + 3) % len(views)].camera for n in range(len(views))]
    moved = [replace(view, camera=camera) for view, camera in zip(views, cameras, strict=True)]
    return replace(data, train=tuple(moved))


def one_view(data: Dataset) -> Dataset:
    return replace(data, train=data.train[:1])


@pytest.mark.parametrize("harmful", [noise, wrong_poses, one_view])
def test_where_it_would_harm_it_is_off_and_says_so(
    scene: TrueScene, caplog: pytest.LogCaptureFixture, harmful: Callable[[Dataset], Dataset]
) -> None:
    sparse, first = start(harmful(replace(scene.data, train=scene.data.train[:6])))
    assert first is sparse
    (record,) = caplog.records
    assert record.levelno == logging.WARNING
    assert record.getMessage().startswith("splat.init=dense: off, since only ")


def test_two_views_are_enough_and_too_little_coverage_is_not(
    scene: TrueScene, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    sparse, first = start(replace(scene.data, train=scene.data.train[:2]))
    assert len(first) >= len(sparse)
    monkeypatch.setattr(dense, "LEAST_GOOD", 0)
    monkeypatch.setattr(dense, "LEAST_COVERED", 1.01)
    sparse, first = start(replace(scene.data, train=scene.data.train[:2]))
    assert first is sparse
    assert "of the training views are covered" in caplog.text


@pytest.mark.slow
def test_a_continued_run_ends_with_the_same_bits(
    scene: TrueScene, losses: Losses, tmp_path: Path
) -> None:
    data = replace(scene.data, train=scene.data.train[:3])
    conf = compose(
        *("train.steps=6", "splat.backend=auto", "+ablation=plus"),
        *("splat.densify.start=0", "splat.densify.every=5000"),
    )
    whole, continued = killed_and_not(data, conf, losses, tmp_path)
    assert sum(whole.stage_seconds.values()) == pytest.approx(whole.seconds, rel=0.1)
    assert continued.stage_seconds["start"] == pytest.approx(whole.stage_seconds["start"], rel=9)
