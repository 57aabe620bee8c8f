"""Keys, building once, freezing, and failed scenes."""

from __future__ import annotations

import json
import multiprocessing
import shutil
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.photos.scene_confs import scene_conf
from xrgs.config import SceneConf, VariantConf
from xrgs.errors import UnreadableError
from xrgs.mixture import mixing, variant
from xrgs.mixture.paths import failed_scenes
from xrgs.mixture.variant import CorruptVariant
from xrgs.mixture.views import SceneFailed, Variant
from xrgs.photos import images

pytestmark = pytest.mark.slow

Build = Callable[..., Variant]
Conf = Callable[..., VariantConf]


def test_a_variant_is_built_once_and_loaded_as_it_was_built(
    shared_store: Path, stereo_variant: Variant, stereo_scene: SceneConf, small_conf: Conf
) -> None:
    """Whatever the scene's label."""
    written = (stereo_variant.folder / "variant.json").stat().st_mtime_ns
    scene, conf = replace(stereo_scene, name="other label"), small_conf(stereo_scene)
    loaded = variant.build(scene, conf, shared_store / "variants", shared_store / "scenes")
    assert (stereo_variant.folder / "variant.json").stat().st_mtime_ns == written
    assert (loaded.id, loaded.folder) == (stereo_variant.id, stereo_variant.folder)
    assert loaded.id.startswith(f"{variant.key(stereo_scene, conf)}-")
    assert variant.find(loaded.folder.parent, "0" * 16) is None
    assert loaded.report == stereo_variant.report
    assert np.array_equal(loaded.points, stereo_variant.points)
    assert np.array_equal(loaded.colors, stereo_variant.colors)
    for a, b in zip(loaded.views, stereo_variant.views, strict=True):
        assert {**vars(a), "K": 0, "viewmat": 0} == {**vars(b), "K": 0, "viewmat": 0}
        assert np.array_equal(a.K, b.K)
        assert np.array_equal(a.viewmat, b.viewmat)


@pytest.fixture
def made(stereo_variant: Variant, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """`stereo_variant` is made again without SfM; the file has a line for each time."""
    home, log = stereo_variant.folder, tmp_path / "made"

    def make(_scene: object, _conf: object, _work: Path, out: Path) -> Variant:
        with log.open("a") as stream:
            stream.write("made\n")
        time.sleep(0.2)
        shutil.copytree(home / "images", out / "images", dirs_exist_ok=True)
        views = (replace(v, file=out / v.file.relative_to(home)) for v in stereo_variant.views)
        return replace(stereo_variant, views=tuple(views))

    monkeypatch.setattr(mixing, "mix_resolutions", make)
    return log


def test_a_corrupt_variant_is_built_anew_with_a_warning_and_what_a_kill_left_is_removed(
    stereo_variant: Variant,
    stereo_scene: SceneConf,
    small_conf: Conf,
    store: Path,
    build: Build,
    made: Path,
    caplog: pytest.LogCaptureFixture,
) -> None:
    copy = store / "variants" / stereo_variant.folder.name
    shutil.copytree(stereo_variant.folder, copy)
    target = next(copy.glob("images/train/*.png"))
    damaged = bytearray(target.read_bytes())
    damaged[len(damaged) // 2] ^= 1
    target.write_bytes(damaged)
    with pytest.raises(CorruptVariant, match=str(target)):
        variant.load(copy)
    key = variant.key(stereo_scene, small_conf(stereo_scene))
    assert variant.find(store / "variants", key) is None
    assert "built anew" in caplog.text
    leftover = store / "variants" / f".{key}.building" / "frozen"
    leftover.mkdir(parents=True)
    (leftover / "variant.json").write_text("half")
    rebuilt = build(stereo_scene)
    aside = store / "variants" / f".{copy.name}.aside-1"
    assert f"renamed to {aside.name}" in caplog.text
    assert (aside / target.relative_to(copy)).read_bytes() == damaged, "nothing is lost"
    assert not leftover.parent.exists()
    found = variant.find(store / "variants", key)
    assert found is not None
    assert found.id == rebuilt.id


def test_a_variant_that_cant_be_read_now_is_neither_removed_nor_built_anew(
    stereo_variant: Variant,
    stereo_scene: SceneConf,
    store: Path,
    build: Build,
    unreadable: Callable[[str], None],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    copy = store / "variants" / stereo_variant.folder.name
    shutil.copytree(stereo_variant.folder, copy)
    before = sorted(path.name for path in copy.parent.iterdir())
    unreadable("points.npz")
    with pytest.raises(UnreadableError, match=r"points\.npz: Input/output error; try again"):
        build(stereo_scene)
    monkeypatch.undo()
    assert sorted(p.name for p in copy.parent.iterdir() if ".lock" not in p.name) == before
    assert build(stereo_scene).id == copy.name


def test_two_processes_at_once_share_one_variant(
    store: Path, made: Path, build: Build, stereo_scene: SceneConf, stereo_variant: Variant
) -> None:
    context = multiprocessing.get_context("fork")
    both = [context.Process(target=build, args=(stereo_scene,)) for _ in range(2)]
    for process in both:
        process.start()
    for process in both:
        process.join()
    assert [process.exitcode for process in both] == [0, 0]
    assert made.read_text() == "made\n"
    names = [p.name for p in (store / "variants").iterdir() if p.name[0] != "."]
    assert names == [stereo_variant.id]


def test_unrelated_photographs_fail_as_a_scene(
    store: Path, small_conf: Conf, build: Build, tmp_path: Path
) -> None:
    rng = np.random.default_rng(0)
    for i in range(5):
        images.save(tmp_path / "x" / f"{i}.png", rng.random((90, 120, 3), dtype=np.float32))
    scene = scene_conf("folder", tmp_path / "x", name="leaves")
    once = {"fallbacks": False}
    with pytest.raises(SceneFailed) as caught:
        build(scene, sfm=once)
    message = str(caught.value)
    assert "scene leaves failed: 0 of 5 photographs are placed, 0 points" in message
    assert "; not placed: 0, 1, 2, 3, 4; " in message
    assert "; undegraded, 0 of 5 photographs are placed. To try: photographs that over" in message
    assert "variant.sfm.min_registered=0.75" in message
    key = variant.key(scene, small_conf(scene, sfm=once))
    variants = store / "variants"
    failed = variants / f"failed-{key}"
    assert str(failed) in message
    report = json.loads((failed / "report.json").read_text())
    reason = report.pop("reason")
    assert report == caught.value.report
    assert message == f"{reason} Report: {failed}"
    assert failed_scenes(variants) == {key: ("leaves", reason)}
    assert variant.failure(variants, key) == reason
    assert variant.failure(variants, "another") is None
    assert report["not_registered"] == ["0", "1", "2", "3", "4"]
    assert "Feature extraction" in (failed / "colmap.log").read_text()
    assert variant.find(variants, key) is None
