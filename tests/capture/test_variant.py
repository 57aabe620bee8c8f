from __future__ import annotations

import ast
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import xrgs
from xrgs.capture import images, scenes, variant
from xrgs.capture.variant import CorruptVariant
from xrgs.capture.views import SceneFailed, Variant, View
from xrgs.config import SceneConf, VariantConf
from xrgs.errors import XrgsError
from xrgs.safeio.hashing import source_digests

PROCEDURAL = SceneConf("procedural", "procedural", None, 24)
PAIR = SceneConf("motorcycle", "motorcycle")


@dataclass(frozen=True)
class Store:
    root: Path
    configured: Callable[..., VariantConf]

    @property
    def variants(self) -> Path:
        return self.root / "variants"

    def conf(self, scene: SceneConf, **changes: Any) -> VariantConf:
        """Small; of a pair neither view is held out."""
        usual: dict[str, Any] = {"long_side": 252}
        if scene.kind == "motorcycle":
            usual = {"long_side": 185, "test_every": 0, "min_hr": 1}
        return self.configured(**usual | changes)

    def key(self, scene: SceneConf, **changes: Any) -> str:
        return variant.key(scene, self.conf(scene, **changes))

    def build(self, scene: SceneConf, **changes: Any) -> Variant:
        conf = self.conf(scene, **changes)
        return variant.build(scene, conf, self.variants, self.root / "scenes")


@pytest.fixture(scope="module")
def shared(
    tmp_path_factory: pytest.TempPathFactory, configured: Callable[..., VariantConf]
) -> Store:
    return Store(tmp_path_factory.mktemp("store"), configured)


@pytest.fixture(scope="module")
def made(shared: Store) -> Variant:
    """The embedded scene at the default recipe."""
    return shared.build(PROCEDURAL)


@pytest.fixture(scope="module")
def pair(shared: Store) -> Variant:
    return shared.build(PAIR)


@pytest.fixture
def store(tmp_path: Path, configured: Callable[..., VariantConf]) -> Store:
    return Store(tmp_path / "store", configured)


def of(built: Variant, split: str, tag: str) -> list[View]:
    return [view for view in built.views if (view.split, view.tag) == (split, tag)]


def project(points: np.ndarray, view: View) -> tuple[np.ndarray, np.ndarray]:
    """Pixels [P, 2] and depths [P]."""
    camera = points @ view.viewmat[:3, :3].T + view.viewmat[:3, 3]
    pixels = camera @ view.K.T
    return pixels[:, :2] / pixels[:, 2:], camera[:, 2]


def photographs(folder: Path, source: Variant, count: int) -> SceneConf:
    """The first views of the embedded scene as a user's folder, under awkward names."""
    folder.mkdir()
    rendered = scenes.resolve(PROCEDURAL, source.path.parents[1] / "scenes", 252)
    for i, file in enumerate(rendered.files[:count]):
        shutil.copy(file, folder / f"vue d'été {i}, x.png")
    return SceneConf("", "folder", str(folder))


# the recipe, on the embedded scene


def test_every_8th_view_is_held_out_and_a_share_of_the_rest_stays_hr(made: Variant) -> None:
    assert made.held_out
    assert made.factor == 5
    assert [v.name for v in of(made, "test", "HR")] == ["view_000", "view_008", "view_016"]
    assert len(of(made, "train", "HR")) == round(0.3 * 21)
    assert len(of(made, "train", "LR")) == 21 - round(0.3 * 21)
    assert len([v for v in made.views if v.split != "original"]) == 24
    assert [(v.split, v.name) for v in made.views] == sorted((v.split, v.name) for v in made.views)


def test_images_have_the_size_of_their_tag(made: Variant) -> None:
    for view in made.views:
        expected = (250, 185) if view.tag == "HR" else (50, 37)
        assert (view.width, view.height) == expected
        assert images.size(view.file) == expected


def test_the_cameras_are_the_exact_ones_up_to_a_similarity(made: Variant) -> None:
    """At 250 px, measured 0.8% and 0.17 degrees; all-HR, intrinsics known, gives 0.46%."""
    error = made.report["pose_error"]
    assert made.report["registered"] == 24
    assert error["position_percent"] < 1.5
    assert error["rotation_degrees"] < 0.4


def test_an_lr_camera_is_the_hr_camera_seen_5_times_smaller(made: Variant) -> None:
    high, low = of(made, "train", "HR")[0], of(made, "train", "LR")[0]
    as_high = replace(low, K=high.K)
    small, _ = project(made.points, low)
    large, _ = project(made.points, as_high)
    assert small * 5 == pytest.approx(large, abs=1e-6)


def test_points_have_the_colour_of_the_pixels_they_fall_on(made: Variant) -> None:
    """Images, cameras and points agree after undistortion, at both sizes."""
    for view in (*of(made, "train", "HR")[:2], *of(made, "train", "LR")[:2]):
        pixels, depth = project(made.points, view)
        inside = (depth > 0) & ((pixels > 0) & (pixels < (view.width, view.height))).all(1)
        assert inside.sum() > 100
        column, row = np.floor(pixels[inside]).astype(int).T
        photo = images.read(view.file)
        seen, expected = photo[row, column], made.colors[inside] / 255
        other = np.random.default_rng(0).permutation(expected)
        assert np.median(np.abs(seen - expected)) < 0.5 * np.median(np.abs(seen - other))


def test_rho_is_the_sampling_rate_over_the_largest(made: Variant) -> None:
    rho = {(view.split, view.name): view.rho for view in made.views}
    assert max(rho.values()) == 1
    for view in of(made, "train", "LR"):
        assert view.rho == pytest.approx(rho["original", view.name] / 5)
    # From the exact cameras: depth of the same points is not known, but focal length is common.
    report = made.report["rho"]
    assert 0 < report["LR"][0] < report["LR"][2] <= 0.2 + 1e-9 < report["HR"][0] <= 1


def test_the_report_tells_how_sfm_went(made: Variant) -> None:
    report = made.report
    assert report["points"] == len(made.points) == len(made.colors) > 300
    assert 0 < report["reprojection_error_px"] < 1.5
    assert report["not_registered"] == report["unreadable"] == []
    assert report["hr_sizes"] == {"250x185": 24}
    assert report["seconds"] > 0
    assert "Feature extraction" in (made.path / "colmap.log").read_text()


# two views, none held out


def test_with_none_held_out_the_tests_are_the_trained_poses_in_hr(pair: Variant) -> None:
    assert not pair.held_out
    names = ["motorcycle_left", "motorcycle_right"]
    assert [v.name for v in of(pair, "test", "HR")] == names
    assert sorted(v.name for v in pair.views if v.split == "train") == names
    assert len(of(pair, "train", "LR")) == len(of(pair, "train", "HR")) == 1


def test_one_pose_at_two_sizes_is_one_picture(pair: Variant) -> None:
    low = of(pair, "train", "LR")[0]
    (high,) = (v for v in of(pair, "test", "HR") if v.name == low.name)
    assert np.array_equal(high.viewmat, low.viewmat)
    small, _ = project(pair.points, low)
    large, _ = project(pair.points, high)
    assert small * 5 == pytest.approx(large, abs=1e-9)
    shrunk = images.resize(images.read(high.file), low.width, low.height)
    assert np.abs(shrunk.clip(0, 1) - images.read(low.file)).max() <= 0.5 / 255 + 1e-6


def test_known_intrinsics_follow_the_resize_and_the_crop(store: Store) -> None:
    """741 x 500 shrinks to 204 x 138 and is cropped to 200 x 135 about its centre."""
    built = store.build(PAIR, long_side=204)
    left = next(v for v in built.views if v.name == "motorcycle_left" and v.split == "test")
    assert (left.width, left.height) == (200, 135)
    assert left.K[0] == pytest.approx([994.978 * 204 / 741, 0, 311.193 * 204 / 741 - 2])
    assert left.K[1] == pytest.approx([0, 994.978 * 138 / 500, 254.877 * 138 / 500 - 1])


def test_native_gives_sfm_the_small_files_as_they_are(store: Store) -> None:
    built = store.build(PAIR, long_side=0, factor=2, sfm={"lr_images": "native"})
    low = of(built, "train", "LR")[0]
    (high,) = (v for v in of(built, "test", "HR") if v.name == low.name)
    assert built.report["registered"] == 2
    assert built.report["lr_images"] == "native"
    assert [low.width * 2, low.height * 2] == [high.width, high.height] == [740, 500]
    assert low.K[:2] * 2 == pytest.approx(high.K[:2])


# frozen


def test_a_loaded_variant_is_the_one_that_was_built(made: Variant) -> None:
    again = variant.load(made.path)
    assert (again.id, again.path, again.report) == (made.id, made.path, made.report)
    assert np.array_equal(again.points, made.points)
    assert np.array_equal(again.colors, made.colors)
    for a, b in zip(again.views, made.views, strict=True):
        assert (a.name, a.file, a.split, a.tag) == (b.name, b.file, b.split, b.tag)
        assert np.array_equal(a.K, b.K)
        assert np.array_equal(a.viewmat, b.viewmat)


def test_a_variant_is_built_once(shared: Store, pair: Variant) -> None:
    written = (pair.path / "variant.json").stat().st_mtime_ns
    assert shared.build(replace(PAIR, name="other label")).id == pair.id
    assert (pair.path / "variant.json").stat().st_mtime_ns == written
    assert not list(shared.variants.glob(".*.building"))


def test_the_key_follows_photographs_config_and_code(
    shared: Store, pair: Variant, monkeypatch: pytest.MonkeyPatch
) -> None:
    key = shared.key(PAIR)
    assert pair.id.startswith(f"{key}-")
    found = variant.find(shared.variants, key)
    assert found is not None
    assert found.id == pair.id
    others = {shared.key(PAIR, seed=1), shared.key(PAIR, sfm={"seed": 1})}
    others.add(variant.key(PROCEDURAL, shared.conf(PAIR)))
    monkeypatch.setattr(variant, "_CODE", variant._CODE[:-1])
    others.add(shared.key(PAIR))
    assert len(others | {key}) == 5
    assert variant.find(shared.variants, "0" * 16) is None


def test_the_code_of_a_variant_is_everything_that_making_one_imports() -> None:
    """What else is imported can't change a variant: it refuses, counts or writes."""
    package = Path(xrgs.__file__).parent
    harmless = {"config", "errors", "files", "foreign", "hashing", "machine", "progress"}
    harmless |= {"scenes"}  # which have marks of their own
    reached, todo = set(), {"variant/mixing"}
    while todo:
        file = todo.pop()
        reached.add(file)
        for node in ast.walk(ast.parse((package / f"{file}.py").read_text())):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("xrgs"):
                for alias in node.names:
                    room, *inner = f"{node.module}.{alias.name}".split(".")[1:]
                    todo |= {f"variant/{inner[0]}" if room == "variant" else room} - harmless
        todo -= reached
    reached |= {"variant/frozen", "variant/__init__"}
    assert {f"{file}.py" for file in reached} == set(source_digests(*variant._CODE))


@pytest.mark.parametrize(
    "damage", ["image byte", "image gone", "points", "camera", "json", "report"]
)
def test_a_corrupt_variant_is_rebuilt_with_a_warning_not_trusted(
    pair: Variant, store: Store, damage: str, caplog: pytest.LogCaptureFixture
) -> None:
    copy = store.variants / pair.path.name
    shutil.copytree(pair.path, copy)
    file = {"points": "points.npz", "report": "report.json"}.get(damage, "variant.json")
    target = copy / file if "image" not in damage else next(copy.glob("images/train/*.png"))
    if damage == "image gone":
        target.unlink()
    elif damage == "camera":
        content = json.loads(target.read_text())
        content["views"][0]["K"][0][0] += 1
        target.write_text(json.dumps(content))
    elif damage in ("json", "report"):
        target.write_text("{")
    else:
        content = bytearray(target.read_bytes())
        content[len(content) // 2] ^= 1
        target.write_bytes(content)
    with pytest.raises(CorruptVariant, match=str(copy)):
        variant.load(copy)
    key = store.key(PAIR)
    assert variant.find(store.variants, key) is None
    assert "built anew" in caplog.text
    rebuilt = store.build(PAIR)
    found = variant.find(store.variants, key)
    assert found is not None
    assert found.id == rebuilt.id


def test_what_a_killed_process_left_is_cleared(store: Store) -> None:
    left = store.variants / f".{store.key(PAIR)}.building" / "frozen"
    left.mkdir(parents=True)
    (left / "variant.json").write_text("half")
    store.build(PAIR)
    assert not left.parent.exists()


def test_two_processes_at_once_share_one_variant(store: Store) -> None:
    script = (
        "from pathlib import Path; from xrgs.capture import variant;"
        "from xrgs.config import SceneConf, SfmConf, VariantConf;"
        f"conf = {store.conf(PAIR)!r}; root = Path({str(store.root)!r});"
        f"print(variant.build({PAIR!r}, conf, root / 'variants', root / 'scenes').id)"
    )
    run = [sys.executable, "-P", "-c", script]
    both = [subprocess.Popen(run, stdout=subprocess.PIPE, text=True) for _ in range(2)]
    ids = {process.communicate()[0].strip() for process in both}
    assert [process.returncode for process in both] == [0, 0]
    assert len(ids) == 1
    assert [p.name for p in store.variants.iterdir() if p.name[0] != "."] == list(ids)


# what users bring


def test_an_unreadable_photograph_is_left_out_and_told(
    made: Variant, store: Store, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    scene = photographs(tmp_path / "photos à moi", made, 9)
    broken = tmp_path / "photos à moi" / "vue d'été 3, x.png"
    broken.write_bytes(broken.read_bytes()[:5000])
    built = store.build(scene, test_every=4, hr_fraction=0.5)
    assert built.scene == "photos à moi"
    assert str(broken) in built.report["unreadable"][0]
    assert f"{broken}: " in caplog.text
    assert "truncated" in caplog.text
    names = {view.name for view in built.views}
    assert "vue d'été 3, x" not in names
    assert {"vue d'été 0, x", "vue d'été 5, x"} <= names  # 4th of those that can be read
    assert {v.name for v in of(built, "test", "HR")} == {"vue d'été 0, x", "vue d'été 5, x"}


def test_one_readable_photograph_is_too_few(made: Variant, store: Store, tmp_path: Path) -> None:
    scene = photographs(tmp_path / "x", made, 2)
    (tmp_path / "x" / "vue d'été 1, x.png").write_bytes(b"no image")
    with pytest.raises(XrgsError, match=r"x: 1 readable image.*été 1, x\.png"):
        store.build(scene)
    assert not list(store.variants.glob("*-*"))


def test_views_of_differing_sizes_keep_their_own_size_and_camera(
    made: Variant, store: Store, tmp_path: Path
) -> None:
    """Half of the photographs cut down at their sides: what is left has the same focal length."""
    scene = photographs(tmp_path / "x", made, 12)
    cut = [f"vue d'été {i}, x" for i in range(0, 12, 2)]
    for name in cut:
        file = tmp_path / "x" / f"{name}.png"
        images.save(file, images.read(file)[:, 25:-25])  # 202 x 189
    built = store.build(scene, factor=1, test_every=3)
    assert built.report["registered"] == 12
    assert built.report["hr_sizes"] == {"202x189": 6, "252x189": 6}
    assert built.report["cameras"] == 12  # no EXIF to say that any two are of one camera
    for view in built.views:
        assert (view.width, view.height) == ((202, 189) if view.name in cut else (252, 189))
        assert images.size(view.file) == (view.width, view.height)
        assert view.K[:2, 2].tolist() == [view.width / 2, view.height / 2]
    focal = np.median([view.K[0, 0] for view in built.views])
    assert focal == pytest.approx(0.9 * 252, rel=0.15)  # each found from its own 250 px alone


def test_a_factor_that_leaves_too_few_pixels_is_named(store: Store) -> None:
    with pytest.raises(XrgsError, match=r"variant\.factor=30: LR views of 8x6 px"):
        store.build(replace(PROCEDURAL, views=2), factor=30)


def test_a_bad_config_is_refused_before_anything_is_made(store: Store) -> None:
    with pytest.raises(XrgsError, match=r"variant\.selection=best"):
        store.build(PROCEDURAL, selection="best")
    assert not store.root.exists()


def test_photographs_of_nothing_in_common_fail_as_a_scene(store: Store, tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    for i in range(5):
        images.save(tmp_path / "x" / f"{i}.png", rng.random((90, 120, 3), dtype=np.float32))
    scene = SceneConf("leaves", "folder", str(tmp_path / "x"))
    with pytest.raises(SceneFailed) as caught:
        store.build(scene)
    message = str(caught.value)
    assert "scene leaves failed: COLMAP placed 0 of 5 views (not 0, 1, 2, 3, 4)" in message
    assert "variant.sfm.min_registered=0.75" in message
    failed = store.variants / f"failed-{store.key(scene)}"
    assert str(failed) in message
    report = json.loads((failed / "report.json").read_text())
    reason = report.pop("reason")
    assert report == caught.value.report
    assert message == f"{reason} Report: {failed}"
    assert variant.failure(store.variants, failed.name.removeprefix("failed-")) == reason
    assert variant.failure(store.variants, "another") is None
    assert report["not_registered"] == ["0", "1", "2", "3", "4"]
    assert "Feature extraction" in (failed / "colmap.log").read_text()
    assert variant.find(store.variants, store.key(scene)) is None


def test_too_few_views_placed_to_train_on_fail_whatever_was_asked(
    store: Store, tmp_path: Path
) -> None:
    images.save(tmp_path / "x" / "a.png", np.zeros((90, 120, 3), np.float32))
    images.save(tmp_path / "x" / "b.png", np.ones((90, 120, 3), np.float32))
    scene = SceneConf("flat", "folder", str(tmp_path / "x"))
    with pytest.raises(SceneFailed, match="0 HR, 0 LR and 0 test views; 1 of each, 2 to train"):
        store.build(scene, sfm={"min_registered": 0.0})


@pytest.mark.data
def test_fern_is_placed_at_a_reduced_size(store: Store) -> None:
    path = Path(os.environ.get("XRGS_TEST_DATA", "../shared/data")) / "llff" / "fern"
    if not path.is_dir():
        pytest.skip(f"{path} is not there; XRGS_TEST_DATA names the folder that has llff/fern")
    fern = SceneConf("fern", "folder", str(path))
    built = store.build(fern, sfm={"max_num_features": 2000})
    assert built.report["registered"] == 20
    assert [len(of(built, *part)) for part in (("test", "HR"), ("train", "HR"))] == [3, 5]
    assert {(v.width, v.height) for v in of(built, "train", "LR")} == {(50, 37)}
    assert len(built.points) > 250
