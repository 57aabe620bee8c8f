"""What a variant holds: tags, degraded views, poses and their report; SfM is run once for all."""

from __future__ import annotations

import shutil
import zlib  # noqa: F401  pycolmap corrupts the heap where it is imported before zlib
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest
import yaml

from tests.mixture.poses.written import write_model
from tests.photos.scene_confs import scene_conf
from xrgs import config
from xrgs.config import VariantConf
from xrgs.mixture import mixing, sfm
from xrgs.mixture.degradations import DEGRADATIONS
from xrgs.mixture.photographs import prepare_hr_views, write_degraded
from xrgs.mixture.sfm import SfmImage
from xrgs.mixture.tags import POLICIES
from xrgs.mixture.views import Reconstruction, SceneFailed, Variant, View
from xrgs.photos import images, scenes
from xrgs.photos.scenes import Scene, procedural

pytestmark = pytest.mark.slow

Make = Callable[..., VariantConf]
Mix = Callable[..., Variant]
VIEWS = 12


@pytest.fixture(scope="module")
def configured(configured: Make) -> Make:
    """Small views, whose poses are compared with SfM of the undegraded photographs."""
    return partial(configured, long_side=160, min_hr=0, test_every=4, sfm={"reference": True})


@pytest.fixture(scope="module")
def conf(configured: Make) -> VariantConf:
    return configured()


@pytest.fixture(scope="module")
def rendered(tmp_path_factory: pytest.TempPathFactory, conf: VariantConf) -> Scene:
    cache = tmp_path_factory.mktemp("scenes")
    return scenes.resolve(
        scene_conf("procedural", name="p", views=VIEWS),
        cache,
        conf.long_side,
    )


@pytest.fixture(scope="module")
def reconstruction(
    rendered: Scene, tmp_path_factory: pytest.TempPathFactory, conf: VariantConf
) -> Reconstruction:
    """SfM of the undegraded photographs, run once for all tests of what comes before and after."""
    work = tmp_path_factory.mktemp("work")
    inputs = []
    for file in rendered.files.values():
        shutil.copy(str(file), work / file.name)
        inputs.append(SfmImage(file.name, file.stem, "all"))
    return sfm.reconstruct(inputs, work, work, conf.sfm)


@pytest.fixture
def given() -> list[list[str]]:
    """The files that each call of SfM gets."""
    return []


@pytest.fixture
def mix(
    configured: Make,
    rendered: Scene,
    reconstruction: Reconstruction,
    given: list[list[str]],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> Mix:
    """(scene, **changes) -> `mix_resolutions` with `reconstruction` in the place of SfM.

    The default scene has no exact cameras.
    """

    def recall(inputs: Sequence[SfmImage], *_: object) -> Reconstruction:
        given.append([image.file for image in inputs])
        return reconstruction

    def run(scene: Scene | None = None, **changes: Any) -> Variant:
        work, out = tmp_path / "work", tmp_path / "out"
        work.mkdir()
        (out / "images").mkdir(parents=True)
        scene = scene or replace(rendered, viewmats={})
        return mixing.mix_resolutions(scene, configured(**changes), work, out)

    monkeypatch.setattr(sfm, "reconstruct", recall)
    return run


def of(made: Variant, split: str, tag: str) -> list[View]:
    return [view for view in made.views if (view.split, view.tag) == (split, tag)]


def number(view: View) -> int:
    return int(view.name[-3:])


# tags


def test_by_sampling_rate_the_highest_are_hr_and_nothing_is_degraded(
    mix: Mix, given: list[list[str]]
) -> None:
    """The embedded scene's cameras are all about as far away: rho differs by 15 % at most."""
    made = mix(tags="sampling_rate")
    high, low = of(made, "train", "HR"), of(made, "train", "LR")
    assert len(high) == round(0.3 * 9)
    assert len(high) + len(low) == 9
    assert min(v.sampling_rate for v in high) >= max(v.sampling_rate for v in low)
    assert not of(made, "original", "HR")
    assert {(v.width, v.height) for v in made.views} == {(160, 120)}
    assert given == [[f"sfm/{i:05d}.png" for i in range(VIEWS)]]
    assert made.report["degradation"] == "none"
    assert made.report["pose_error"] == {}
    assert made.report["rho"]["HR"][0] == min(v.sampling_rate for v in high)
    note, need = made.report["notes"]
    rho = [view.sampling_rate for view in (*high, *low)]
    assert "variant.tags=sampling_rate is meaningless" in note
    assert f"rho is {min(rho):.3f} to {max(rho):.3f}" in note
    assert need == (
        "sampling rates of training views differ by 1.1 where they show the same points:"
        " components.supersampled, where it is on, renders none of the views larger"
    )


def test_by_distance_the_closest_are_hr_and_the_others_are_degraded_after_sfm(
    mix: Mix, given: list[list[str]]
) -> None:
    """Every camera looks at one point, so that the exact cameras say which are close to it."""
    made = mix(tags="distance", degradation="downsample")
    assert given == [[f"sfm/{i:05d}.png" for i in range(VIEWS)]]
    poses = procedural.viewmats(VIEWS)
    middle = np.array([0.0, 0.1, 5.5, 1.0])
    depth = {v.name: (poses[number(v)] @ middle)[2] for v in made.views}
    high, low = ([depth[v.name] for v in of(made, "train", tag)] for tag in ("HR", "LR"))
    assert np.mean(high) < np.mean(low) - 0.2
    assert min(low) > min(high)
    degraded = of(made, "train", "LR")
    assert {(v.width, v.height) for v in degraded} == {(32, 24)}
    assert [v.name for v in of(made, "original", "HR")] == [v.name for v in degraded]


def test_by_megapixels_the_larger_photographs_are_hr(
    mix: Mix, rendered: Scene, tmp_path: Path, given: list[list[str]]
) -> None:
    files = {name: tmp_path / file.name for name, file in rendered.files.items()}
    for i, (name, file) in enumerate(rendered.files.items()):
        photo = images.read(file)
        images.save(files[name], images.resize(photo, 80, 60) if i % 3 else photo)
    scene = replace(rendered, files=files, viewmats={})
    made = mix(scene, tags="megapixels", hr_above=0.75)
    assert {number(v) for v in of(made, "train", "HR")} == {3, 6, 9}
    assert all((v.width, v.height) == (80, 60) for v in of(made, "train", "LR"))
    assert not of(made, "original", "HR")
    assert made.report["rho"]["LR"][1] == pytest.approx(0.5, abs=0.1)
    assert round(min(view.supersampling for view in of(made, "train", "LR"))) == 2
    assert made.report["notes"][-1].endswith("renders 6 of 9 of the views larger")
    for view in of(made, "test", "HR"):  # at its own full size
        assert (view.width, view.height) == ((160, 120) if number(view) % 3 == 0 else (80, 60))


@pytest.mark.parametrize(("fraction", "tag"), [(0.0, "LR"), (1.0, "HR")])
def test_one_class_alone_where_the_config_says_so(mix: Mix, fraction: float, tag: str) -> None:
    made = mix(hr_fraction=fraction)
    assert len(of(made, "train", tag)) == 9
    assert len(of(made, "original", "HR")) == (9 if tag == "LR" else 0)
    assert len(of(made, "test", "HR")) == 3


# degradations


def test_each_degraded_view_has_its_original_from_the_same_pose(
    mix: Mix, given: list[list[str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """And the poses are compared with those of the undegraded photographs."""
    monkeypatch.setattr(mixing, "lr_blur", lambda _: 0.87)
    made = mix()
    low = of(made, "train", "LR")
    (note,) = made.report["notes"]
    assert note.startswith("LR photographs are blurrier than their pixels: by a Gaussian of 0.87")
    assert made.report["lr_blur"] == 0.87
    assert len(given) == 2
    assert sum(file.startswith("sfm_lr_up/") for file in given[0]) == len(low)
    assert given[1] == [f"sfm/{i:05d}.png" for i in range(VIEWS)]
    assert made.report["pose_error"]["position_percent"] == pytest.approx(0, abs=1e-6)
    assert made.report["pose_error_against"] == "SfM of the undegraded photographs"
    assert made.report["reference"]["registered"] == VIEWS
    assert made.report["reference"]["seconds"] >= 0
    originals = {view.name: view for view in of(made, "original", "HR")}
    assert sorted(originals) == [view.name for view in low]
    for view in low:
        high = originals[view.name]
        assert np.array_equal(high.viewmat, view.viewmat)
        assert (high.width, high.height) == (160, 120) == (view.width * 5, view.height * 5)
        assert high.K[:2] == pytest.approx(view.K[:2] * 5)
        assert view.supersampling == pytest.approx(5 * high.supersampling, rel=0.01)
        assert high.supersampling == pytest.approx(1, rel=0.2)
        shrunk = images.resize(images.read(high.file), view.width, view.height)
        # The lens is nearly a pinhole, so that undistortion and downsampling commute.
        assert np.abs(shrunk - images.read(view.file)).mean() < 0.01


@pytest.mark.parametrize("how", ["digital_zoom", "jpeg"])
def test_a_degradation_may_keep_the_size(
    mix: Mix, given: list[list[str]], monkeypatch: pytest.MonkeyPatch, how: str
) -> None:
    """Its views are blurry on purpose, which no note says."""
    monkeypatch.setattr(mixing, "lr_blur", lambda _: 0.87)
    made = mix(degradation=how, hr_fraction=0.5)
    assert not any("blurrier" in note for note in made.report["notes"])
    assert {(v.width, v.height) for v in made.views} == {(160, 120)}
    originals = {v.name: v for v in of(made, "original", "HR")}
    for view in of(made, "train", "LR"):
        before, after = images.read(originals[view.name].file), images.read(view.file)
        assert 0.005 < np.abs(before - after).mean() < 0.1
        assert (
            view.sampling_rate == originals[view.name].sampling_rate
        )  # px per unit; not what is in them
        resolved = {"jpeg": 1, "digital_zoom": 5}[how]
        assert view.supersampling == pytest.approx(resolved * originals[view.name].supersampling)
    low = {number(v) for v in of(made, "train", "LR")}
    assert given[0] == [f"{'sfm_lr' if i in low else 'sfm'}/{i:05d}.png" for i in range(VIEWS)]


def test_noise_depends_on_a_views_name_and_on_the_seed_alone(
    rendered: Scene, configured: Make, tmp_path: Path
) -> None:
    """In another order, and beside other views, a view has the same bytes."""
    conf = configured(degradation="phone", factor=2)
    photos = prepare_hr_views(rendered, conf, tmp_path)

    def written(which: Sequence[int], **changes: Any) -> dict[int, bytes]:
        write_degraded(photos, which, replace(conf, **changes))
        return {i: (photos.folder / photos.file("lr", i)).read_bytes() for i in which}

    first = written([0, 1, 2])
    assert len(set(first.values())) == 3
    assert written([2, 0]) == {i: first[i] for i in (0, 2)}
    assert written([0], seed=1)[0] != first[0]


# poses


def test_exact_cameras_need_no_second_run_of_sfm(
    mix: Mix, rendered: Scene, given: list[list[str]]
) -> None:
    made = mix(rendered)
    assert len(given) == 1
    assert made.report["pose_error_against"] == "exact cameras"
    assert 0 < made.report["pose_error"]["position_percent"] < 5


def part(model: Reconstruction, views: int) -> Reconstruction:
    """The first views of a model."""
    first = {i: model.viewmats[i] for i in range(views)}
    return replace(
        model, viewmats=first, report=model.report | {"models": [views, 3], "registered": views}
    )


@pytest.mark.parametrize(
    ("undegraded", "degradation", "said"),
    [
        (10, "downsample", "undegraded, 10 of 12 photographs are placed. To try: variant.factor=3"),
        (10, "none", "requires more. To try: variant.sfm.long_side=0 (the photographs have 160"),
    ],
)
def test_a_failed_scene_says_who_is_missing_why_and_what_to_try(
    configured: Make,
    rendered: Scene,
    reconstruction: Reconstruction,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    undegraded: int,
    degradation: str,
    said: str,
) -> None:
    def reconstruct(inputs: Sequence[SfmImage], *_: object) -> Reconstruction:
        mixed = degradation == "none" or any("lr" in image.file for image in inputs)
        return part(reconstruction, 5 if mixed else undegraded)

    monkeypatch.setattr(sfm, "reconstruct", reconstruct)
    (tmp_path / "out/images").mkdir(parents=True)
    split = {"selection": "uniform", "hr_fraction": 0.5}
    conf = configured(degradation=degradation, sfm={"long_side": 100}, **split)
    with pytest.raises(SceneFailed) as caught:
        mixing.mix_resolutions(rendered, conf, tmp_path, tmp_path / "out")
    message = str(caught.value)
    points = len(reconstruction.points)
    assert message.startswith(
        f"scene p failed: 5 of 12 photographs are placed, {points} points; not placed: view_005, "
        "view_006, view_007, view_008, view_009, view_010 and 1 more; variant.sfm.min_registered"
    )
    assert said in message
    assert "photographs between the separate parts of 5 and 3, variant.poses=FOLDER" in message
    assert message.endswith("variant.sfm.min_registered=0.41 to go on without the others.")
    expected = undegraded if degradation == "downsample" else None
    assert caught.value.report.get("reference", {}).get("registered") == expected


# the choices in conf/


def test_every_variant_in_conf_is_of_one_tag_or_degradation() -> None:
    files = {file.stem: file for file in (config.CONF_DIR / "variant").iterdir()}
    assert files.keys() == POLICIES.keys() | DEGRADATIONS.keys() - {"downsample"}  # the default
    for name, file in files.items():
        content = yaml.safe_load(file.read_text())
        assert content.pop("tags" if name in POLICIES else "degradation") == name
        assert content.keys() <= {"factor", "hr_above"}


# what the user gives


def test_given_poses_replace_sfm_and_are_scaled_for_lr_views(
    mix: Mix, rendered: Scene, given: list[list[str]], tmp_path: Path
) -> None:
    """The exact cameras of the embedded scene, of twice its photographs' size."""
    names = list(rendered.files)
    K = procedural.intrinsics(320, 240)
    params = [K[0, 0], K[1, 1], K[0, 2], K[1, 2]]
    camera = pycolmap.Camera(model="PINHOLE", width=320, height=240, params=params)
    matrices = {f"{n}.jpg": procedural.viewmats(VIEWS)[int(n[-3:])] for n in names[:-1]}
    points = np.random.default_rng(0).uniform((-1, -1, 5), (1, 1, 6), (20, 3))
    write_model(tmp_path / "poses", camera, matrices, points)
    made = mix(poses=str(tmp_path / "poses"))
    assert given == [], "no SfM, nor one of the undegraded photographs"
    assert made.report["not_registered"] == names[-1:]
    assert {view.name for view in made.views} == set(names[:-1])
    exact = procedural.intrinsics(160, 120)
    true = procedural.viewmats(VIEWS)
    # Given poses are moved to a world of their own, rigidly and all alike.
    first = made.views[0]
    to_given = np.linalg.inv(first.viewmat) @ true[number(first)]
    assert np.allclose(to_given[:3, :3] @ to_given[:3, :3].T, np.eye(3), atol=1e-9)
    for view in made.views:
        assert np.allclose(view.viewmat @ to_given, true[number(view)], atol=1e-9)
        scale = view.width / 160
        assert scale in {1, 1 / 5}
        assert np.allclose(view.K, np.diag([scale, scale, 1]) @ exact, atol=1e-9)
    assert {v.name for v in of(made, "train", "LR")} == set(made.report["lr"]) - {names[-1]}
