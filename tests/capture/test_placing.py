from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from xrgs.capture import degrade, images, placing, scenes, sfm
from xrgs.capture.photographs import Photographs, prepare, write_degraded
from xrgs.capture.sfm import Reconstruction
from xrgs.config import SceneConf, SfmConf, VariantConf

Make = Callable[..., VariantConf]


@pytest.fixture
def photos(configured: Make, tmp_path: Path) -> Photographs:
    """The stereo pair, the right view with a degraded copy 5 times smaller."""
    scene = scenes.resolve(SceneConf("motorcycle", "motorcycle"), tmp_path)
    conf = configured(long_side=185, degradation="downsample")
    made = prepare(scene, conf, tmp_path)
    write_degraded(made, [1], conf)
    return made


def placed(views: int) -> Reconstruction:
    """A result of so many views, as far as `place` looks at it."""
    poses = {i: np.eye(4) for i in range(views)}
    told = dict.fromkeys(("lr_images", "first_octave", "max_num_features"), 0)
    told |= {"init_min_tri_angle": 0, "min_inliers": 0, "models": [views], "points": 0}
    report = told | {"registered": views}
    return Reconstruction({}, poses, np.zeros((0, 3)), np.zeros((0, 3), np.uint8), {}, report)


def test_recipes_are_tried_until_one_places_enough(
    photos: Photographs, sfm_conf: SfmConf, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """The first two refused, whatever they found: the third, on the second's features, is kept."""
    verdicts = iter(["too few", "too few", "", "never asked"])
    done = placing.place(photos, [1], sfm_conf, tmp_path, lambda _: next(verdicts))
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
    assert sorted(p.name for p in tmp_path.glob("sfm*")) == ["sfm", "sfm-finer"]
    assert len(list((tmp_path / "sfm-finer").glob("models-*"))) == 2
    assert "recipe finer: too few" in caplog.text


def test_the_first_recipe_is_the_last_where_it_places_enough(
    photos: Photographs, sfm_conf: SfmConf, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sfm, "reconstruct", lambda *_: placed(2))
    done = placing.place(photos, [1], sfm_conf, tmp_path, lambda _: "")
    assert [a["attempt"] for a in done.attempts] == ["configured"]


@pytest.mark.parametrize("fallbacks", [True, False])
def test_where_all_are_refused_the_fullest_is_told(
    photos: Photographs,
    sfm_conf: SfmConf,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    fallbacks: bool,
) -> None:
    results = iter([placed(0), placed(2), placed(1), placed(0)])
    monkeypatch.setattr(sfm, "reconstruct", lambda *_: next(results))
    recipe = replace(sfm_conf, fallbacks=fallbacks)
    done = placing.place(
        photos, [1], recipe, tmp_path, lambda model: f"{len(model.viewmats)} are too few"
    )
    assert [a["registered"] for a in done.attempts] == ([0, 2, 1, 0] if fallbacks else [0])
    assert done.refused == ("2 are too few" if fallbacks else "0 are too few")


@pytest.mark.parametrize(("given", "other"), [("upsampled", "native"), ("native", "upsampled")])
def test_the_last_recipe_gives_small_images_the_other_way(
    sfm_conf: SfmConf, given: str, other: str
) -> None:
    recipe = replace(sfm_conf, lr_images=given)
    names = [name for name, _, _ in placing.recipes(recipe, 20, smaller=True)]
    assert names == ["configured", "finer", "relaxed", other]
    assert [r.lr_images for _, _, r in placing.recipes(recipe, 20, smaller=True)][-1] == other
    same = [name for name, _, _ in placing.recipes(recipe, 20, smaller=False)]
    assert same == ["configured", "finer", "relaxed"]


def test_small_images_are_given_upsampled_or_with_a_camera_of_their_own(
    photos: Photographs, sfm_conf: SfmConf
) -> None:
    upsampled = placing.shots(photos, [1], sfm_conf)
    assert [shot.file for shot in upsampled] == ["hr/00000.png", "up/00001.png"]
    assert images.size(photos.folder / "up/00001.png") == photos.size("hr", 1)
    native = placing.shots(photos, [1], replace(sfm_conf, lr_images="native"))
    assert [shot.file for shot in native] == ["hr/00000.png", "lr/00001.png"]
    assert pytest.approx(upsampled[0].K) == native[0].K
    assert native[1].K[:2] * 5 == pytest.approx(upsampled[1].K[:2])


def test_a_degraded_copy_of_full_size_is_given_as_it_is(
    configured: Make, sfm_conf: SfmConf, tmp_path: Path
) -> None:
    scene = scenes.resolve(SceneConf("motorcycle", "motorcycle"), tmp_path)
    conf = configured(long_side=185, degradation="jpeg")
    assert degrade.kind(conf) == "jpeg"
    made = prepare(scene, conf, tmp_path)
    write_degraded(made, [1], conf)
    for how in ("upsampled", "native"):
        given = placing.shots(made, [1], replace(sfm_conf, lr_images=how))
        assert [shot.file for shot in given] == ["hr/00000.png", "lr/00001.png"]
    assert not (tmp_path / "up").exists()


def test_a_refusal_is_a_warning_and_success_is_silent(
    photos: Photographs,
    sfm_conf: SfmConf,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    monkeypatch.setattr(sfm, "reconstruct", lambda *_: placed(2))
    placing.place(photos, [1], sfm_conf, tmp_path, lambda _: "")
    assert not [r for r in caplog.records if r.levelno >= logging.WARNING]
