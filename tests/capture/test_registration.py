"""Which images SfM gets, and which attempts follow where too few views register."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from xrgs.capture import images, registration, scenes, sfm
from xrgs.capture.photographs import PhotoCollection, prepare_hr_views, write_degraded
from xrgs.capture.sfm import Reconstruction
from xrgs.config import SceneConf, SfmConf, VariantConf

Make = Callable[..., VariantConf]


@pytest.fixture
def photos(configured: Make, stereo_scene: SceneConf, tmp_path: Path) -> PhotoCollection:
    """The stereo pair, and a degraded copy of the right view that is 5 times smaller."""
    scene = scenes.resolve(stereo_scene, tmp_path)
    conf = configured(long_side=185, degradation="downsample")
    made = prepare_hr_views(scene, conf, tmp_path)
    write_degraded(made, [1], conf)
    return made


def registered(views: int, points: int = 0) -> Reconstruction:
    """A reconstruction with so many views, as far as `register` reads it."""
    poses = {i: np.eye(4) for i in range(views)}
    settings = dict.fromkeys(("lr_images", "first_octave", "max_num_features"), 0)
    settings |= {"init_min_tri_angle": 0, "min_inliers": 0}
    results = {"models": [views], "points": points, "registered": views}
    return Reconstruction(
        {}, poses, np.zeros((0, 3)), np.zeros((0, 3), np.uint8), {}, settings | results
    )


def test_attempts_follow_until_one_is_accepted(
    photos: PhotoCollection, sfm_conf: SfmConf, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """The first two are refused, whatever they found; the third reuses the second's features."""
    refusals = iter(["too few", "too few", "", "never read"])
    done = registration.register(photos, [1], sfm_conf, tmp_path, lambda _: next(refusals))
    assert done.refused == ""
    assert [a["attempt"] for a in done.attempts] == ["configured", "finer", "relaxed"]
    assert [a["refused"] for a in done.attempts] == ["too few", "too few", ""]
    first, finer, relaxed = done.attempts
    assert finer["max_num_features"] == relaxed["max_num_features"] == 2 * 8192
    assert [a["init_min_tri_angle"] for a in done.attempts] == [4, 4, 1]
    assert [a["min_inliers"] for a in done.attempts] == [30, 30, 15]
    assert first["registered"] == 2
    assert first["seconds"] > 0
    assert done.model.report["min_inliers"] == 15
    folders = sorted(path.name for path in tmp_path.glob("sfm*"))
    assert folders == ["sfm-configured", "sfm-finer"]
    assert len(list((tmp_path / "sfm-finer").glob("models-*"))) == 2
    assert "SfM attempt finer: too few" in caplog.text


def test_an_accepted_first_attempt_is_the_only_one(
    photos: PhotoCollection,
    sfm_conf: SfmConf,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    monkeypatch.setattr(sfm, "reconstruct", lambda *_: registered(2))
    done = registration.register(photos, [1], sfm_conf, tmp_path, lambda _: "")
    assert [a["attempt"] for a in done.attempts] == ["configured"]
    assert not [r for r in caplog.records if r.levelno >= logging.WARNING]


@pytest.mark.parametrize("fallbacks", [True, False])
def test_where_all_are_refused_the_one_with_most_views_is_returned(
    photos: PhotoCollection,
    sfm_conf: SfmConf,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    fallbacks: bool,
) -> None:
    results = iter([registered(0), registered(2), registered(1), registered(0)])
    monkeypatch.setattr(sfm, "reconstruct", lambda *_: next(results))
    done = registration.register(
        photos,
        [1],
        replace(sfm_conf, fallbacks=fallbacks),
        tmp_path,
        lambda model: f"{len(model.viewmats)} are too few",
    )
    assert [a["registered"] for a in done.attempts] == ([0, 2, 1, 0] if fallbacks else [0])
    assert done.refused == ("2 are too few" if fallbacks else "0 are too few")


def test_of_refused_attempts_with_equally_many_views_the_first_is_returned(
    photos: PhotoCollection, sfm_conf: SfmConf, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    results = iter([registered(1, 10), registered(1, 40), registered(1, 20), registered(1, 30)])
    monkeypatch.setattr(sfm, "reconstruct", lambda *_: next(results))
    done = registration.register(
        photos, [1], sfm_conf, tmp_path, lambda model: f"{model.report['points']} points"
    )
    assert len(done.attempts) == 4
    assert done.refused == "10 points"
    assert done.model.report["points"] == 10


@pytest.mark.parametrize(("given", "other"), [("upsampled", "native"), ("native", "upsampled")])
def test_the_last_attempt_gives_small_images_the_other_way(
    sfm_conf: SfmConf, given: str, other: str
) -> None:
    conf = replace(sfm_conf, lr_images=given)
    attempts = list(registration.sfm_attempts(conf, 20, any_smaller=True))
    assert [attempt.name for attempt in attempts] == ["configured", "finer", "relaxed", other]
    assert attempts[-1].conf.lr_images == other
    same_size = registration.sfm_attempts(conf, 20, any_smaller=False)
    assert [attempt.name for attempt in same_size] == ["configured", "finer", "relaxed"]


@pytest.mark.parametrize(("inliers", "relaxed"), [(30, 15), (14, 7), (12, 6), (11, 6), (6, 6)])
def test_half_of_the_inliers_are_never_fewer_than_colmaps_six(
    sfm_conf: SfmConf, inliers: int, relaxed: int
) -> None:
    conf = replace(sfm_conf, min_inliers=inliers)
    attempts = list(registration.sfm_attempts(conf, 20, any_smaller=True))
    assert [attempt.conf.min_inliers for attempt in attempts] == [inliers, inliers, *[relaxed] * 2]


def test_small_images_are_upsampled_or_have_a_camera_of_their_own(
    photos: PhotoCollection, sfm_conf: SfmConf
) -> None:
    upsampled = registration.sfm_images(photos, [1], sfm_conf)
    assert [image.file for image in upsampled] == ["hr/00000.png", "up/00001.png"]
    assert images.size(photos.folder / "up/00001.png") == photos.size("hr", 1)
    native = registration.sfm_images(photos, [1], replace(sfm_conf, lr_images="native"))
    assert [image.file for image in native] == ["hr/00000.png", "lr/00001.png"]
    assert pytest.approx(upsampled[0].K) == native[0].K
    native_K, upsampled_K = native[1].K, upsampled[1].K
    assert native_K is not None
    assert upsampled_K is not None
    assert native_K[:2] * 5 == pytest.approx(upsampled_K[:2])


def test_a_degraded_copy_of_full_size_is_given_as_it_is(
    configured: Make, sfm_conf: SfmConf, stereo_scene: SceneConf, tmp_path: Path
) -> None:
    scene = scenes.resolve(stereo_scene, tmp_path)
    conf = configured(long_side=185, degradation="jpeg")
    made = prepare_hr_views(scene, conf, tmp_path)
    write_degraded(made, [1], conf)
    for lr_images in ("upsampled", "native"):
        given = registration.sfm_images(made, [1], replace(sfm_conf, lr_images=lr_images))
        assert [image.file for image in given] == ["hr/00000.png", "lr/00001.png"]
    assert not (tmp_path / "up").exists()
