"""The dense start as training gets it: its gate, its bits, its time, and continued runs."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from tests.conftest import composed as compose
from tests.training.conftest import comparable, same
from tests.training.dense.conftest import TrueScene
from xrgs.config import Conf
from xrgs.splat.gaussians import Gaussians, from_points
from xrgs.store import identity
from xrgs.training import dense
from xrgs.training.checkpoint import Checkpoint
from xrgs.training.dataset import Dataset
from xrgs.training.loop import train


def sparse_of(data: Dataset) -> Gaussians:
    generator = torch.Generator().manual_seed(0)
    return from_points(data.points, data.colors, init_opacity=0.1, sh_degree=3, generator=generator)


def start(data: Dataset) -> tuple[Gaussians, Gaussians]:
    """The Gaussians on SfM points, and those that training starts from."""
    sparse = sparse_of(data)
    return sparse, dense.dense_start(data, sparse, "torch", torch.Generator().manual_seed(1))


def test_sfm_points_come_first_and_squares_fill_the_budget(scene: TrueScene) -> None:
    sparse, first = start(scene.data)
    budget = round(dense.BUDGET * scene.data.view_pixels)
    assert len(sparse) + 0.99 * budget < len(first) <= len(sparse) + budget
    head, tail = slice(len(sparse)), slice(len(sparse), None)
    assert all(torch.equal(first[name][head], sparse[name]) for name in ("means", "scales", "sh0"))
    assert torch.sigmoid(first.opacities[tail]).sub(dense.OPACITY).abs().max() < 1e-6
    assert first.shN[tail].eq(0).all()
    assert all(first[name].requires_grad and first[name].is_leaf for name in ("means", "quats"))
    # They show the first view better than the SfM points do, before any training.
    conf = compose("train.steps=1", "splat.init=dense")
    losses = [
        train(scene.data, replace(conf, splat=replace(conf.splat, init=init))).history[0]["loss"]
        for init in ("sfm", "dense")
    ]
    assert losses[1] < 0.6 * losses[0]


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
    assert same(*starts)


def noise(data: Dataset) -> Dataset:
    """Photographs that have nothing in common."""
    generator = torch.Generator().manual_seed(0)
    views = [
        replace(v, pixels=torch.randint(256, v.pixels.shape, generator=generator).byte())
        for v in data.train
    ]
    return replace(data, train=tuple(views))


def flat(data: Dataset) -> Dataset:
    """Photographs without texture."""
    views = [replace(v, pixels=torch.full_like(v.pixels, 99)) for v in data.train]
    return replace(data, train=tuple(views))


def wrong_poses(data: Dataset) -> Dataset:
    """Each photograph with the pose of another."""
    views = data.train
    cameras = [views[(n + 3) % len(views)].camera for n in range(len(views))]
    moved = [replace(view, camera=camera) for view, camera in zip(views, cameras, strict=True)]
    return replace(data, train=tuple(moved))


def one_view(data: Dataset) -> Dataset:
    return replace(data, train=data.train[:1])


@pytest.mark.parametrize("harmful", [noise, flat, wrong_poses, one_view])
def test_where_it_would_harm_it_is_off_and_says_so(
    scene: TrueScene, caplog: pytest.LogCaptureFixture, harmful: object
) -> None:
    assert callable(harmful)
    sparse, first = start(harmful(replace(scene.data, train=scene.data.train[:6])))
    assert first is sparse
    (record,) = caplog.records
    assert record.levelno == logging.WARNING
    assert record.getMessage().startswith("splat.init=dense: off, since only ")


def test_too_little_coverage_is_off_too(
    scene: TrueScene, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(dense, "LEAST_COVERED", 1.01)
    sparse, first = start(replace(scene.data, train=scene.data.train[:4]))
    assert first is sparse
    assert "of the training views are covered" in caplog.text


@pytest.mark.parametrize("count", [2, 3])
def test_two_or_three_views_are_enough(scene: TrueScene, count: int) -> None:
    sparse, first = start(replace(scene.data, train=scene.data.train[:count]))
    assert len(first) >= len(sparse)


def short(*overrides: str) -> Conf:
    return compose("train.steps=6", "splat.init=dense", "splat.backend=auto", *overrides)


@pytest.mark.parametrize("arm", ["baseline", pytest.param("plus", marks=pytest.mark.slow)])
def test_a_continued_run_ends_with_the_same_bits(
    scene: TrueScene, tmp_path: Path, arm: str
) -> None:
    data = replace(scene.data, train=scene.data.train[:5])
    conf = short(f"+ablation={arm}", "splat.densify.start=0", "splat.densify.every=5000")
    whole = train(data, conf)
    assert whole.stage_seconds["start"] > 0
    assert sum(whole.stage_seconds.values()) == pytest.approx(whole.seconds, rel=0.1)

    class Kill(BaseException):
        pass

    class KilledAfterThree(Checkpoint):
        def save_if_due(self, step: int) -> float:
            seconds = super().save_if_due(step)
            if step == 2:
                raise Kill
            return seconds

    with pytest.raises(Kill):
        train(data, conf, KilledAfterThree(tmp_path / "c.npz", "cell", 1e-9))
    checkpoint = Checkpoint(tmp_path / "c.npz", "cell", 1e-9)
    assert checkpoint.load() == 3
    continued = train(data, conf, checkpoint)
    assert comparable(continued) == comparable(whole)
    assert continued.stage_seconds["start"] == pytest.approx(whole.stage_seconds["start"], rel=9)


def test_its_code_is_part_of_a_cell_where_it_is_on() -> None:
    on, off = compose("splat.init=dense"), compose()
    code = [identity.cell_identity(conf, "v").code for conf in (on, off)]
    assert code[0].keys() - code[1].keys() == {"dense"}
    assert "init" not in identity.cell_identity(off, "v").splat
    assert identity.changed_code(identity.cell_identity(on, "v")) == []
