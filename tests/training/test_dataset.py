from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from xrgs.config import TRAINING_VIEWS
from xrgs.errors import XrgsError
from xrgs.mixture.views import Variant, View
from xrgs.photos import images
from xrgs.photos.images import ImageError
from xrgs.training import dataset
from xrgs.training.dataset import LoadedView

HR, LR = (40, 30), (20, 15)


def make_view(folder: Path, name: str, split: str, tag: str, size: tuple[int, int]) -> View:
    """A view of one grey, whose pose depends on its name alone."""
    number = int(name[1:])
    grey = {"train": 0.1, "test": 0.2, "original": 0.3}[split] + number / 20
    file = folder / f"{split}/{name}.png"
    images.save(file, np.full((size[1], size[0], 3), grey, np.float32))
    viewmat = np.eye(4)
    viewmat[:3, 3] = (-0.3 * number, 0.1 * (number % 2), 0.05 * number)
    K = np.array([[size[0], 0, size[0] / 2], [0, size[0], size[1] / 2], [0, 0, 1.0]])
    finer = HR[0] / size[0]
    return View(name, file, split, tag, *size, K, viewmat, 1 / finer, supersampling=finer)


@pytest.fixture
def variant(tmp_path: Path) -> Variant:
    """Five views: v0 is the test, v1 HR, v2 to v4 downsampled by 2, with their originals."""
    folder = tmp_path
    views = [make_view(folder, f"v{i}", "original", "HR", HR) for i in (2, 3, 4)]
    views += [
        make_view(folder, "v0", "test", "HR", HR),
        make_view(folder, "v1", "train", "HR", HR),
    ]
    views += [make_view(folder, f"v{i}", "train", "LR", LR) for i in (2, 3, 4)]
    points = np.random.default_rng(0).normal((0, 0, 4), 1, (50, 3))
    colors = np.zeros((50, 3), np.uint8)
    return Variant("id", folder, "grey", 2, True, tuple(views), points, colors, {})


def grey(view: LoadedView) -> float:
    return round(float(view.image.mean()) * 20) / 20


def test_mixed_is_the_default_and_takes_the_views_as_they_are(variant: Variant) -> None:
    data = dataset.load(variant)
    assert [(v.name, v.tag) for v in data.train] == [
        ("v1", "HR"),
        ("v2", "LR"),
        ("v3", "LR"),
        ("v4", "LR"),
    ]
    assert [v.name for v in data.test] == ["v0"]
    assert [v.sampling_rate for v in data.train] == [1, 0.5, 0.5, 0.5]
    assert [v.supersampling for v in data.train] == [1, 2, 2, 2]
    for view in data.train:
        size = HR if view.tag == "HR" else LR
        assert view.image.shape == (size[1], size[0], 3)
        assert (view.camera.width, view.camera.height) == size


def test_a_photograph_is_8_bits_in_memory_and_read_png_on_demand(variant: Variant) -> None:
    every = np.arange(40 * 30 * 3, dtype=np.uint8).reshape(30, 40, 3)
    Image.fromarray(every).save(variant.views[3].file)
    (view,) = dataset.load(variant).test
    assert view.pixels.dtype == torch.uint8
    np.testing.assert_array_equal(view.pixels, every)
    np.testing.assert_array_equal(view.image, images.read_png(variant.views[3].file))
    assert view.image.dtype == torch.float32


def test_all_hr_takes_originals_from_the_same_poses(variant: Variant) -> None:
    mixed, high = dataset.load(variant), dataset.load(variant, "all_hr")
    assert [(v.name, v.tag, v.sampling_rate) for v in high.train] == [
        (f"v{i}", "HR", 1.0) for i in range(1, 5)
    ]
    assert [grey(v) for v in high.train] == [0.15, 0.4, 0.45, 0.5]  # originals from v2 on
    assert all(v.image.shape == (30, 40, 3) for v in high.train)
    for a, b in zip(mixed.train, high.train, strict=True):
        assert torch.equal(a.camera.viewmat, b.camera.viewmat)


@pytest.mark.parametrize("use", ["all_hr", "hr_only", "lr_only"])
def test_the_world_and_the_tests_are_the_same_whatever_is_trained_on(
    variant: Variant, use: str
) -> None:
    # Nor do originals move the world.
    without = replace(variant, views=tuple(v for v in variant.views if v.split != "original"))
    mixed, other = dataset.load(without), dataset.load(variant, use)
    names = {"all_hr": ["v1", "v2", "v3", "v4"], "hr_only": ["v1"], "lr_only": ["v2", "v3", "v4"]}
    assert [v.name for v in other.train] == names[use]
    assert other.scene_scale == mixed.scene_scale
    assert torch.equal(other.points, mixed.points)
    assert torch.equal(other.test[0].camera.viewmat, mixed.test[0].camera.viewmat)
    assert torch.equal(other.test[0].image, mixed.test[0].image)
    poses = {v.name: v.camera.viewmat for v in mixed.train}
    assert all(torch.equal(v.camera.viewmat, poses[v.name]) for v in other.train)


def test_a_use_without_views_is_refused(variant: Variant) -> None:
    without = replace(variant, views=tuple(v for v in variant.views if v.split != "original"))
    with pytest.raises(XrgsError, match="no original of v2"):
        dataset.load(without, "all_hr")
    high = replace(variant, views=tuple(v for v in without.views if v.tag == "HR"))
    assert [v.name for v in dataset.load(high, "all_hr").train] == ["v1"]
    with pytest.raises(XrgsError, match=r"views=lr_only: variant id has no LR training view"):
        dataset.load(high, "lr_only")
    with pytest.raises(XrgsError, match=r"views=best: must be one of mixed, all_hr, hr_only, lr"):
        dataset.load(variant, "best")


def test_an_image_of_another_size_than_the_list_says_is_named(variant: Variant) -> None:
    views = tuple(replace(v, width=v.width + 1) if v.name == "v3" else v for v in variant.views)
    with pytest.raises(ImageError, match=r"train/v3\.png: .*it has 20 x 15 pixels, not 21 x 15"):
        dataset.load(replace(variant, views=views))


@pytest.mark.parametrize("of", ["points", "cameras"])
def test_a_world_that_cant_be_normalised_is_one_line(variant: Variant, of: str) -> None:
    """Points beyond float64's range, and cameras whose up axes cancel out."""
    points, views = variant.points, variant.views
    if of == "points":
        points = np.full((5, 3), 1e300) * np.arange(5)[:, None]
    else:
        turns = [np.eye(4), np.diag([-1.0, -1.0, 1.0, 1.0])] * 2
        upright = [v for v in views if v.split != "original"]
        views = tuple(replace(v, viewmat=t) for v, t in zip(upright, turns, strict=False))
    with pytest.raises(XrgsError, match="its cameras and points can't be of one scene"):
        dataset.load(replace(variant, points=points, views=views))


@pytest.fixture
def many(variant: Variant) -> Variant:
    """One test view, eight HR and three LR training views, and originals of the latter."""
    more = [make_view(variant.folder, f"v{i}", "train", "HR", HR) for i in range(5, 12)]
    return replace(variant, views=(*variant.views, *more))


def names(views: tuple[LoadedView, ...]) -> list[str]:
    return [view.name for view in views]


@pytest.mark.parametrize(("share", "count"), [(0.01, 1), (0.25, 2), (0.75, 6)])
def test_a_share_of_the_hr_training_views_is_scored_and_not_trained_on(
    many: Variant, share: float, count: int
) -> None:
    data, whole = dataset.load(many, validation=share), dataset.load(many)
    assert len(data.test) == count
    assert names(data.test) == [n for n in names(whole.train) if n not in names(data.train)]
    assert "v0" not in names(data.test), "the test view"
    assert {view.tag for view in data.test} == {"HR"}
    trained = {view.name: view for view in whole.train}
    for view in data.test:
        assert torch.equal(view.image, trained[view.name].image), "not an original or a test view"
        assert torch.equal(view.camera.viewmat, trained[view.name].camera.viewmat)


def test_every_control_of_a_seed_holds_out_the_same_views(many: Variant) -> None:
    mixed = dataset.load(many, validation=0.25, seed=3)
    left = set(names(mixed.train))
    for use in TRAINING_VIEWS:
        data = dataset.load(many, use, validation=0.25, seed=3)
        assert names(data.test) == names(mixed.test)
        assert names(data.train) == [n for n in names(dataset.load(many, use).train) if n in left]
        assert data.scene_scale == dataset.load(many).scene_scale
        assert torch.equal(data.points, mixed.points)
    assert names(dataset.load(many, "lr_only", validation=0.25).train) == ["v2", "v3", "v4"]


@pytest.mark.parametrize(("share", "folds"), [(0.125, 8), (0.5, 2)])
def test_the_seeds_hold_out_each_hr_view_once(many: Variant, share: float, folds: int) -> None:
    held_out = [
        names(dataset.load(many, validation=share, seed=seed).test) for seed in range(folds)
    ]
    every_hr_view = sorted(view.name for view in dataset.load(many, "hr_only").train)
    assert sorted(name for fold in held_out for name in fold) == every_hr_view
    again = names(dataset.load(many, validation=share, seed=folds).test)
    assert again == held_out[0], "the seeds go around"
    assert names(dataset.load(many, seed=5).test) == ["v0"], "0 scores the test views"


def test_held_out_views_must_leave_two_hr_views(many: Variant) -> None:
    three = replace(many, views=many.views[:-5])
    assert len(dataset.load(three, "hr_only", validation=0.1).train) == 2
    two = replace(many, views=many.views[:-6])
    for variant, share, use in ((two, 0.1, "mixed"), (two, 0.1, "lr_only"), (many, 0.9, "all_hr")):
        with pytest.raises(XrgsError, match=rf"train\.validation={share}: .*at least 2 HR"):
            dataset.load(variant, use, validation=share)
    for share in (-0.1, 1.0, float("nan")):
        with pytest.raises(XrgsError, match=rf"train\.validation={share}: must be 0, or a share"):
            dataset.load(many, validation=share)
