"""Which images SfM gets, and which attempts follow where too few views register."""

from __future__ import annotations

import zlib  # noqa: F401  pycolmap corrupts the heap where it is imported before zlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest
from numpy.typing import NDArray
from PIL import Image
from scipy.ndimage import map_coordinates
from skimage import data

from tests.mixture.poses.written import write_model
from xrgs.config import SceneConf, SfmConf, VariantConf
from xrgs.mixture import poses, sfm, sfm_retries
from xrgs.mixture.photographs import PhotoCollection, prepare_hr_views, write_degraded
from xrgs.mixture.views import Reconstruction
from xrgs.photos import images, scenes
from xrgs.photos.lens import Lens
from xrgs.photos.scenes import Scene

Make = Callable[..., VariantConf]
Register = Callable[..., sfm_retries.Registration]
SIZE = (240, 180)
DEPTH = 5.0
CAMERA = pycolmap.Camera(
    model="OPENCV",
    width=SIZE[0],
    height=SIZE[1],
    params=[200.0, 210.0, 125.0, 85.0, -0.15, 0.02, 0.004, -0.003],
)


@pytest.fixture
def photos(configured: Make, stereo_scene: SceneConf, tmp_path: Path) -> PhotoCollection:
    """The stereo pair, and a degraded copy of the right view that is 5 times smaller."""
    scene = scenes.resolve(stereo_scene, tmp_path)
    conf = configured(degradation="downsample", sfm={"long_side": 185})
    made = prepare_hr_views(scene, conf, tmp_path, for_sfm=True)
    write_degraded(made, [1], conf, "sfm_lr")
    return made


@pytest.fixture
def register(
    photos: PhotoCollection, sfm_conf: SfmConf, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Register:
    """(what SfM gives at each attempt, refusal, photos, **settings) -> `register` of `photos`."""

    def registered(
        reconstruct: Callable[..., Reconstruction],
        refuse: Callable[[Reconstruction], str] = lambda _: "",
        given: PhotoCollection = photos,
        **settings: Any,
    ) -> sfm_retries.Registration:
        monkeypatch.setattr(sfm, "reconstruct", reconstruct)
        conf = replace(sfm_conf, **settings)
        return sfm_retries.register(given, [1], conf, tmp_path, refuse)

    return registered


def attempt(conf: SfmConf) -> sfm_retries.Attempt:
    return sfm_retries.Attempt("configured", conf)


def registered(views: int, points: int = 0) -> Reconstruction:
    """A reconstruction with so many views, as far as `register` reads it."""
    poses = {i: np.eye(4) for i in range(views)}
    settings = dict.fromkeys(("lr_images", "first_octave", "max_num_features"), 0)
    settings |= {"init_min_tri_angle": 0, "min_inliers": 0}
    results = {"models": [views], "points": points, "registered": views}
    return Reconstruction(
        {}, poses, np.zeros((0, 3)), np.zeros((0, 3), np.uint8), {}, settings | results
    )


@pytest.mark.slow
def test_attempts_follow_until_one_is_accepted(
    photos: PhotoCollection, sfm_conf: SfmConf, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Three are refused, whatever they found; the same features and matches are reused."""
    refusals = iter(["too few", "too few", "too few", "", "never read"])
    done = sfm_retries.register(photos, [1], sfm_conf, tmp_path, lambda _: next(refusals))
    assert done.refused == ""
    names = ["configured", "relaxed", "finer", "narrower"]
    assert [a["attempt"] for a in done.attempts] == names
    assert [a["refused"] for a in done.attempts] == ["too few", "too few", "too few", ""]
    assert [a["max_num_features"] for a in done.attempts] == [8192, 8192, 2 * 8192, 2 * 8192]
    assert [a["init_min_tri_angle"] for a in done.attempts] == [4, 4, 4, 1]
    assert [a["min_inliers"] for a in done.attempts] == [30, 15, 15, 15]
    assert done.attempts[0]["registered"] == 2
    assert done.attempts[0]["seconds"] > 0
    assert done.model.report["init_min_tri_angle"] == done.attempt.conf.init_min_tri_angle == 1
    for name in ("configured", "finer"):
        assert len(list((tmp_path / f"sfm-{name}").glob("models-*"))) == 2
    assert not (tmp_path / "sfm-relaxed").exists()
    assert "SfM attempt finer: too few" in caplog.text


@pytest.mark.parametrize(("second", "refused"), [(2, ""), (2, "no")])
def test_an_accepted_attempt_that_lacks_a_view_is_followed_by_one_more(
    register: Register, second: int, refused: str
) -> None:
    results, refusals = iter([registered(1), registered(second)]), iter(["", refused])
    done = register(lambda *_: next(results), lambda _: next(refusals))
    assert [a["attempt"] for a in done.attempts] == ["configured", "relaxed"]
    assert done.refused == ""
    better = second == 2 and not refused
    assert len(done.model.viewmats) == (2 if better else 1)
    assert done.attempt.conf.min_inliers == (15 if better else 30)


@pytest.mark.parametrize("fallbacks", [True, False])
def test_where_all_are_refused_the_first_with_most_views_is_returned(
    register: Register, fallbacks: bool
) -> None:
    results = iter([registered(*found) for found in ((0, 0), (2, 10), (1, 30), (0, 0), (2, 40))])

    def refuse(model: Reconstruction) -> str:
        return f"{model.report['points']} are too few"

    done = register(lambda *_: next(results), refuse, fallbacks=fallbacks)
    assert [a["registered"] for a in done.attempts] == ([0, 2, 1, 0, 2] if fallbacks else [0])
    assert done.refused == ("10 are too few" if fallbacks else "0 are too few")


def with_exif(photos: PhotoCollection, focal: float | None) -> PhotoCollection:
    known = (replace(photo, K=None, focal_35mm=focal) for photo in photos.all)
    return replace(photos, all=tuple(known))


def test_an_attempt_is_without_the_focal_length_of_exif(
    photos: PhotoCollection, register: Register
) -> None:
    given: list[list[sfm.SfmImage]] = []

    def reconstruct(sfm_images: list[sfm.SfmImage], *_: object) -> Reconstruction:
        given.append(sfm_images)
        return registered(2 if sfm_images[0].focal is None else 1)

    def refuse(model: Reconstruction) -> str:
        return "" if len(model.viewmats) == 2 else "too few"

    done = register(reconstruct, refuse, with_exif(photos, 300.0))
    assert [a["attempt"] for a in done.attempts] == ["configured", "relaxed", "without_exif"]
    assert all(image.focal for images_of in given[:-1] for image in images_of)
    assert [image.focal for image in given[-1]] == [None, None]
    assert done.refused == ""
    (note,) = done.model.report["notes"]
    assert note.startswith("the focal length in EXIF (300 mm of 35 mm film) was not used")


@pytest.mark.parametrize(
    ("error", "views", "is_taken"), [(0.5, 2, True), (1.5, 2, False), (0.5, 1, False)]
)
def test_views_that_fit_another_camera_are_tried_with_one(
    photos: PhotoCollection, register: Register, error: float, views: int, is_taken: bool
) -> None:
    given: list[list[sfm.SfmImage]] = []

    def reconstruct(sfm_images: list[sfm.SfmImage], *_: object) -> Reconstruction:
        given.append(sfm_images)
        found = registered(2 if len(given) == 1 else views)
        errors = {"reprojection_error_px": 1.0 if len(given) == 1 else error}
        apart = {1: 1} if len(given) == 1 else {}
        return replace(found, report=found.report | errors, apart=apart)

    known = with_exif(photos, 28.0)
    done = register(reconstruct, given=known)
    assert [a["attempt"] for a in done.attempts] == ["configured", "cameras_apart"]
    first, second = given
    assert second[0] == first[0]
    assert second[1].camera not in {first[0].camera, first[1].camera}
    assert second[1].focal is None
    assert done.attempt.apart == ({1: 1} if is_taken else {})
    notes = done.model.report["notes"]
    assert len(notes) == is_taken
    assert not notes or f"{known.names[1]} fit with another focal length" in notes[0]


@pytest.mark.parametrize(("given", "other"), [("upsampled", "native"), ("native", "upsampled")])
def test_the_last_attempt_gives_small_images_the_other_way(
    sfm_conf: SfmConf, given: str, other: str
) -> None:
    """Half of the inliers are never fewer than COLMAP's six."""
    conf = replace(sfm_conf, lr_images=given, min_inliers=11)
    attempts = list(sfm_retries.sfm_attempts(conf, 20, any_smaller=True))
    names = ["configured", "relaxed", "finer", "narrower"]
    assert [attempt.name for attempt in attempts] == [*names, other]
    assert attempts[-1].conf.lr_images == other
    assert [attempt.conf.min_inliers for attempt in attempts] == [11, 6, 6, 6, 6]
    same_size = sfm_retries.sfm_attempts(conf, 20, any_smaller=False)
    assert [attempt.name for attempt in same_size] == names


def test_small_images_are_upsampled_or_have_a_camera_of_their_own(
    photos: PhotoCollection, sfm_conf: SfmConf
) -> None:
    upsampled = sfm_retries.sfm_images(photos, [1], attempt(sfm_conf))
    assert [image.file for image in upsampled] == ["sfm/00000.png", "sfm_lr_up/00001.png"]
    assert images.size(photos.folder / "sfm_lr_up/00001.png") == photos.size("sfm", 1)
    native = sfm_retries.sfm_images(photos, [1], attempt(replace(sfm_conf, lr_images="native")))
    assert [image.file for image in native] == ["sfm/00000.png", "sfm_lr/00001.png"]
    assert pytest.approx(upsampled[0].K) == native[0].K
    native_K, upsampled_K = native[1].K, upsampled[1].K
    assert native_K is not None
    assert upsampled_K is not None
    assert native_K[:2] * 5 == pytest.approx(upsampled_K[:2], rel=0.01)


def test_the_lens_of_an_image_for_sfm_is_mapped_to_the_hr_view(
    photos: PhotoCollection, register: Register
) -> None:
    """The right view is 741 x 500 px: 185 x 125 for SfM, and 504 x 340 cropped to 500 x 340."""
    hr = photos[1].hr
    assert (hr.resized, hr.width, hr.height) == ((504, 340), 500, 340)
    seen = Lens("SIMPLE_RADIAL", (185.0, 92.5, 62.5, 0.1), 185, 125)
    model = replace(registered(1), lenses={1: seen})
    done = register(lambda *_: model)
    made = done.model.lenses[1]
    assert (made.width, made.height, made.params) == (500, 340, seen.params)
    assert pytest.approx(np.array([[504, 0, 250], [0, 185 * 340 / 125, 170], [0, 0, 1]])) == made.K


def viewmat(index: int) -> NDArray[np.float64]:
    angle = 0.12 * (index - 1.5)
    matrix = np.eye(4)
    matrix[:3, :3] = pycolmap.Rotation3d(np.array([0.05 * index, angle, 0.1 * index])).matrix()
    matrix[:3, 3] = matrix[:3, :3] @ np.array([0.6 * (1.5 - index), 0.1 * index, 0.0])
    return matrix


def photograph(index: int) -> NDArray[np.uint8]:
    """The wall z = 5 through the lens: pycolmap says which ray each stored pixel sees."""
    x, y = np.meshgrid(np.arange(SIZE[0]) + 0.5, np.arange(SIZE[1]) + 0.5)
    rays = CAMERA.cam_from_img(np.stack([x.ravel(), y.ravel()], -1))
    rays = np.c_[rays, np.ones(len(rays))] @ viewmat(index)[:3, :3]
    centre = -viewmat(index)[:3, :3].T @ viewmat(index)[:3, 3]
    wall = centre + rays * ((DEPTH - centre[2]) / rays[:, 2:])
    texture = data.hubble_deep_field().astype(np.float64)
    rows, columns = 436 + 90 * wall[:, 1], 500 + 90 * wall[:, 0]
    bands = [map_coordinates(texture[..., c], (rows, columns), order=1) for c in range(3)]
    return np.stack(bands, -1).reshape(SIZE[1], SIZE[0], 3).astype(np.uint8)


@pytest.fixture
def wall(tmp_path: Path, configured: Callable[..., VariantConf]) -> PhotoCollection:
    """Four photographs of the wall, which EXIF turns by a quarter, and their poses."""
    exif, files = Image.Exif(), {f"wall{i}": tmp_path / f"wall{i}.png" for i in range(4)}
    exif[0x112] = 6
    for i, file in enumerate(files.values()):
        Image.fromarray(photograph(i)).save(file, exif=exif)
    matrices = {file.name: viewmat(i) for i, file in enumerate(files.values())}
    write_model(tmp_path / "poses", CAMERA, matrices, np.zeros((0, 3)))
    (tmp_path / "work").mkdir()
    return prepare_hr_views(Scene("x", "", files), configured(long_side=0), tmp_path / "work")


@pytest.mark.slow
def test_points_of_distorted_and_turned_photographs_are_on_the_wall(
    wall: PhotoCollection, tmp_path: Path, configured: Callable[..., VariantConf]
) -> None:
    model = poses.read_poses(str(tmp_path / "poses"), wall)
    assert len(model.points) == 0
    found = sfm_retries.with_points(model, wall, (), configured().sfm, tmp_path)
    assert len(found.points) > 50
    # Given poses are moved to a world of their own: bring the points back to the wall's.
    on_wall = (found.points - model.world[:3, 3]) @ model.world[:3, :3]
    off = np.abs(on_wall[:, 2] - DEPTH)
    # Features are found to 0.15 px: an error of depth of 0.15 z² / (f b), at a baseline b of 1.2.
    assert np.median(off) < 0.016
    assert np.quantile(off, 0.9) < 0.1
    assert found.report["notes"][-1] == (
        f"variant.poses has no points: {len(found.points)} were triangulated from the photographs"
    )
    assert found.report["reprojection_error_px"] < 0.5
    assert found.lenses == model.lenses
    assert all(len(found.observed[i]) > 20 for i in range(4))
