"""Images of a variant that are made again from the photographs, against those of the build."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from plyfile import PlyData, PlyElement

from tests.photos.scene_confs import scene_conf
from xrgs.config import SceneConf, VariantConf
from xrgs.errors import StoreError, XrgsError
from xrgs.mixture import saved_variant
from xrgs.mixture.views import Variant
from xrgs.photos import images
from xrgs.photos.scenes import procedural
from xrgs.safeio.hashing import file_digest
from xrgs.store import trimming

pytestmark = pytest.mark.slow

Build = Callable[..., Variant]
Conf = Callable[..., VariantConf]
Restore = Callable[..., None]


def without_images(built: Variant, folder: Path) -> Path:
    """Copy a variant's folder, all but its images."""
    shutil.copytree(built.folder, folder, ignore=shutil.ignore_patterns("images"))
    return folder


def hashes(folder: Path) -> dict[str, str]:
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    return {str(path.relative_to(folder)): file_digest(path) for path in files}


@pytest.fixture
def made_again(tmp_path: Path, stereo_scene: SceneConf, small_conf: Conf) -> Restore:
    """(folder, scene, conf) -> makes the images in it, by default of the stereo pair."""

    def run(folder: Path, scene: SceneConf = stereo_scene, conf: VariantConf | None = None) -> None:
        work = tmp_path / "work"
        work.mkdir(exist_ok=True)
        scenes = tmp_path / "store" / "scenes"  # of `build`, which has rendered them
        trimming.restore_images(folder, scene, conf or small_conf(scene), work, scenes)

    return run


def test_the_stereo_pair_has_the_same_images(
    stereo_variant: Variant, made_again: Restore, tmp_path: Path
) -> None:
    folder = without_images(stereo_variant, tmp_path / stereo_variant.id)
    made_again(folder)
    assert saved_variant.verify(folder) == []
    assert hashes(folder) == hashes(stereo_variant.folder)


def test_a_lens_for_each_photograph_has_the_same_images_and_masks(
    procedural_scene: SceneConf, build: Build, small_conf: Conf, made_again: Restore, tmp_path: Path
) -> None:
    """The lenses are given with the poses, so that no SfM is run."""
    poses = np.linalg.inv(procedural.viewmats(4)) @ np.diag([1, -1, -1, 1])  # OpenGL's axes
    frames = [
        {"file_path": f"view_{i:03d}.png", "transform_matrix": pose.tolist(), "k1": 0.01 * i}
        for i, pose in enumerate(poses)
    ]
    points = np.zeros(6, [(axis, "f4") for axis in "xyz"])
    points["z"] = np.arange(6) + 4
    PlyData([PlyElement.describe(points, "vertex")]).write(tmp_path / "points.ply")
    file = tmp_path / "transforms.json"
    file.write_text(json.dumps({"fl_x": 230.0, "ply_file_path": "points.ply", "frames": frames}))
    (tmp_path / "masks").mkdir()
    for i in (0, 1, 2):
        mask = Image.new("L", (40, 30), 255)
        mask.paste(0, (0, 0, 10, 30))
        mask.save(tmp_path / "masks" / f"view_{i:03d}.png.png")
    scene = replace(procedural_scene, views=4, masks=str(tmp_path / "masks"))
    changes = {"poses": str(file), "factor": 2}
    built = build(scene, **changes)
    assert len(built.report["lenses"]) == 4
    assert {view.name for view in built.views if view.mask is None} == {"view_003"}
    for view in built.views:
        if view.mask is not None:
            assert 0.7 < images.read_mask(view.mask, (view.width, view.height)).mean() < 0.76
    assert 0.24 < built.report["masked"]["test"] < 0.3
    assert "no mask in scene.masks, so that all pixels are used: view_003" in built.report["notes"]
    assert any(note.startswith("masks hide so much") for note in built.report["notes"])
    folder = without_images(built, tmp_path / built.id)
    made_again(folder, scene, small_conf(scene, **changes))
    assert hashes(folder) == hashes(built.folder)


def test_a_damaged_report_is_named(
    stereo_variant: Variant, made_again: Restore, tmp_path: Path
) -> None:
    for number, (old, new, message) in enumerate(
        (
            ('"motorcycle_', '"x_', "report.json: lenses: none is of view motorcycle_"),
            ('"model"', '"x"', r"report.json: lenses\[0\].lens: .*missing required field `model`"),
        )
    ):
        folder = without_images(stereo_variant, tmp_path / str(number) / stereo_variant.id)
        report = folder / "report.json"
        report.write_text(report.read_text().replace(old, new))
        with pytest.raises(StoreError, match=f"damaged: .*{message}"):
            made_again(folder)


def test_photographs_that_changed_and_are_missing_are_named(
    stereo_variant: Variant, made_again: Restore, tmp_path: Path, small_conf: Conf
) -> None:
    photographs = tmp_path / "photographs"
    photographs.mkdir()
    scene = scene_conf("folder", photographs, name="motorcycle")
    conf = small_conf(scene_conf("motorcycle", name="motorcycle"))
    folder = without_images(stereo_variant, tmp_path / stereo_variant.id)
    with pytest.raises(XrgsError, match="photographs"):
        made_again(folder, scene, conf)
    for name, grey in (("motorcycle_left", 80), ("motorcycle_right", 90)):
        Image.new("RGB", (741, 500), (grey, grey, grey)).save(photographs / f"{name}.png")
    with pytest.raises(StoreError, match=r"images/\w+/motorcycle_\w+\.png: .* it is another image"):
        made_again(folder, scene, conf)
