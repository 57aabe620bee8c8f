"""Images of a variant that are made again from the photographs, against those of the build."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from PIL import Image

from xrgs.capture import frozen, restore
from xrgs.capture.lens import Lens
from xrgs.capture.views import Variant
from xrgs.config import SceneConf, VariantConf
from xrgs.errors import StoreError, XrgsError
from xrgs.safeio.confined import ConfinedPath
from xrgs.safeio.hashing import file_digest

pytestmark = pytest.mark.slow

Build = Callable[..., Variant]
Conf = Callable[..., VariantConf]
Restore = Callable[..., None]


def without_images(built: Variant, folder: Path) -> ConfinedPath:
    """Copy a variant's folder, all but its images."""
    shutil.copytree(built.path, folder, ignore=shutil.ignore_patterns("images"))
    return ConfinedPath(folder)


def hashes(folder: Path) -> dict[str, str]:
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    return {str(path.relative_to(folder)): file_digest(path) for path in files}


@pytest.fixture
def made_again(tmp_path: Path, stereo_scene: SceneConf, small_conf: Conf) -> Restore:
    """(folder, scene, conf) -> makes the images in it, by default of the stereo pair."""

    def run(
        folder: ConfinedPath, scene: SceneConf = stereo_scene, conf: VariantConf | None = None
    ) -> None:
        work = ConfinedPath(tmp_path / "work")
        work.make_root()
        restore.restore_images(
            folder, scene, conf or small_conf(scene), work, ConfinedPath(tmp_path)
        )

    return run


def test_the_stereo_pair_has_the_same_images(
    stereo_variant: Variant, made_again: Restore, tmp_path: Path
) -> None:
    folder = without_images(stereo_variant, tmp_path / stereo_variant.id)
    made_again(folder)
    assert frozen.verify(folder) == []
    assert hashes(folder.path) == hashes(stereo_variant.path)


def test_estimated_lenses_and_rendered_photographs_have_the_same_images(
    procedural_variant: Variant,
    procedural_scene: SceneConf,
    made_again: Restore,
    tmp_path: Path,
) -> None:
    """SfM estimates the radial term of this scene, so that its images are resampled."""
    folder = without_images(procedural_variant, tmp_path / procedural_variant.id)
    assert "k=0.0)" not in (folder.path / "report.json").read_text()
    made_again(folder, procedural_scene)
    assert hashes(folder.path) == hashes(procedural_variant.path)


def test_a_lens_for_each_photograph_and_tags_by_depth_have_the_same_images(
    procedural_scene: SceneConf,
    build: Build,
    small_conf: Conf,
    made_again: Restore,
    tmp_path: Path,
) -> None:
    sfm = {"camera": "per_image"}
    conf = small_conf(procedural_scene, tags="distance", sfm=sfm)
    built = build(procedural_scene, tags="distance", sfm=sfm)
    assert len(built.report["lenses"]) > 12
    folder = without_images(built, tmp_path / built.id)
    made_again(folder, procedural_scene, conf)
    assert hashes(folder.path) == hashes(built.path)


def changed(folder: ConfinedPath, name: str, old: str, new: str) -> None:
    """Change a file, and the id in `variant.json`, so that its own hash fits."""
    file = folder.path / name
    text = file.read_text()
    assert old in text
    content = json.loads(text.replace(old, new))
    if name == "variant.json":
        content["id"] = frozen.variant_id(content)
    file.write_text(json.dumps(content))


@pytest.mark.parametrize(
    ("name", "old", "new", "message"),
    [
        ("report.json", '"Lens(', '"Lens(width=', "not a complete variant"),
        ("report.json", "fx=", "fx=1", "report.json has no lens of view motorcycle_"),
        ("report.json", '"lenses"', '"lens"', "not a complete variant"),
        ("report.json", "k=", "unknown=", "not a complete variant"),
        ("variant.json", '"motorcycle_left"', '"../motorcycle_left"', "not a complete variant"),
        ("variant.json", '"split": "original"', '"split": "../../else"', "not a complete variant"),
        ("variant.json", '"split": "test"', '"split": ["test"]', "not a complete variant"),
    ],
)
def test_what_was_written_by_anybody_is_refused_and_writes_nothing_elsewhere(
    stereo_variant: Variant,
    made_again: Restore,
    tmp_path: Path,
    name: str,
    old: str,
    new: str,
    message: str,
) -> None:
    folder = without_images(stereo_variant, tmp_path / "v" / "trimmed")
    changed(folder, name, old, new)
    with pytest.raises(StoreError, match=message):
        made_again(folder)
    images = {path.parent.name for path in tmp_path.rglob("motorcycle*.png")}
    assert images <= {"train", "test", "original"}


def test_photographs_that_changed_and_are_missing_are_named(
    stereo_variant: Variant, made_again: Restore, tmp_path: Path, small_conf: Conf
) -> None:
    photographs = tmp_path / "photographs"
    photographs.mkdir()
    scene = SceneConf(name="motorcycle", kind="folder", path=str(photographs), views=24)
    conf = small_conf(SceneConf(name="motorcycle", kind="motorcycle", path=None, views=24))
    folder = without_images(stereo_variant, tmp_path / stereo_variant.id)
    with pytest.raises(XrgsError, match="photographs"):
        made_again(folder, scene, conf)
    for name in ("motorcycle_left", "motorcycle_right"):
        Image.new("RGB", (741, 500), (90, 90, 90)).save(photographs / f"{name}.png")
    with pytest.raises(StoreError, match=r"images/\w+/motorcycle_\w+\.png: .* it is another image"):
        made_again(folder, scene, conf)


def test_the_report_of_a_variant_has_lenses_as_they_are_printed() -> None:
    """`restore` reads them from there: a variant's folder has them nowhere else."""
    made = Lens(500, 375, 401.25, 401.5, 250.0, 187.5, -0.0123456789012345678)
    assert restore._lenses({"lenses": [repr(made)]}) == [made]
