"""Scenes of every kind: their photographs, names and fingerprints."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from tests.photos.scene_confs import scene_conf
from xrgs.config import SceneConf
from xrgs.errors import XrgsError
from xrgs.photos import images, scenes
from xrgs.photos.scenes import procedural

Fill = Callable[..., SceneConf]
PROCEDURAL = scene_conf("procedural", name="procedural", views=3)


def stems(scene: scenes.Scene) -> list[str]:
    return list(scene.files)


def test_a_folder_is_its_images_sorted_by_name(fill: Fill, tmp_path: Path) -> None:
    conf = fill(tmp_path / "my scene é", "b 1.png", "ä.JPG", "a,2.jpeg")
    (tmp_path / "my scene é" / "notes.txt").write_text("no image")
    (tmp_path / "my scene é" / ".hidden.png").write_bytes(b"")
    scene = scenes.resolve(conf, tmp_path / "cache")
    assert stems(scene) == ["a,2", "b 1", "ä"]
    assert scene.name == scenes.label(conf) == "my scene é"
    named = replace(conf, name="garden", alpha="mask", background=(1, 0, 0.5))
    other = scenes.resolve(named, tmp_path / "cache")
    assert (other.name, other.alpha, other.background) == ("garden", "mask", (1, 0, 0.5))
    assert not scene.intrinsics
    assert not scene.viewmats
    assert not (tmp_path / "cache").exists()


def test_the_fingerprint_follows_names_and_bytes_alone(fill: Fill, tmp_path: Path) -> None:
    conf = fill(tmp_path / "x", "a.png", "b.png")
    first = scenes.fingerprint(conf)
    moved = fill(tmp_path / "y", "a.png", "b.png")
    assert scenes.fingerprint(moved) == first
    assert scenes.fingerprint(replace(conf, name="other")) == first
    (tmp_path / "y" / "b.png").rename(tmp_path / "y" / "c.png")
    assert scenes.fingerprint(moved) != first
    bytes_ = bytearray((tmp_path / "x" / "a.png").read_bytes())
    bytes_[-1] ^= 1
    (tmp_path / "x" / "a.png").write_bytes(bytes_)
    assert scenes.fingerprint(conf) != first


@pytest.mark.slow
def test_the_procedural_scene_has_exact_poses_and_no_intrinsics(tmp_path: Path) -> None:
    first = scenes.resolve(PROCEDURAL, tmp_path, 60)
    assert stems(first) == ["view_000", "view_001", "view_002"]
    assert images.size(next(iter(first.files.values()))) == (60, 45)
    assert first.viewmats.keys() == set(stems(first))
    assert not first.intrinsics  # SfM is to find them, as in a real capture
    assert [p.name for p in tmp_path.iterdir() if p.name[0] != "."] == [first.fingerprint]


def test_a_label_is_one_printable_line(tmp_path: Path) -> None:
    for name, path, shown in (
        ("a\n\x1b[31mb", None, "a  [31mb"),
        ("\n", None, "procedural"),
        ("", str(tmp_path / "a\tb"), "a b"),
    ):
        assert scenes.label(replace(PROCEDURAL, name=name, path=path)) == shown
    assert len(scenes.label(replace(PROCEDURAL, name="x" * 9_999))) == 200


def test_size_and_number_of_views_are_in_the_fingerprint() -> None:
    marks = {
        scenes.fingerprint(PROCEDURAL, 60),
        scenes.fingerprint(PROCEDURAL, 64),
        scenes.fingerprint(replace(PROCEDURAL, views=4), 60),
        scenes.fingerprint(scene_conf("motorcycle", name="motorcycle"), 60),
    }
    assert len(marks) == 4
    with pytest.raises(XrgsError, match=r"scene\.views=1"):
        scenes.fingerprint(replace(PROCEDURAL, views=1), 60)
    full = scenes.fingerprint(PROCEDURAL, procedural.FULL_SIDE)
    assert scenes.fingerprint(PROCEDURAL, 0) == full


def test_what_becomes_of_alpha_is_in_the_fingerprint() -> None:
    mask = replace(PROCEDURAL, alpha="mask")
    white = replace(PROCEDURAL, background=(1.0, 1.0, 1.0))
    assert len({scenes.fingerprint(conf, 60) for conf in (PROCEDURAL, mask, white)}) == 3
    with pytest.raises(XrgsError, match=r"scene\.alpha=none: must be one of composite, mask"):
        scenes.fingerprint(replace(PROCEDURAL, alpha="none"))
    with pytest.raises(XrgsError, match=r"scene\.background=\[0, 0, 255\]: values must be 0 to 1"):
        scenes.fingerprint(replace(PROCEDURAL, background=(0, 0, 255)))


def test_folders_called_images_have_the_name_of_the_folder_around_them(tmp_path: Path) -> None:
    for path in ("pa/images", "pb/images", "pa/other", "pb/other"):
        (tmp_path / path).mkdir(parents=True)

    def confs(*paths: str) -> list[SceneConf]:
        return [scene_conf("folder", tmp_path / path) for path in paths]

    assert [scenes.label(conf) for conf in confs("pa/images", "pb/images")] == ["pa", "pb"]
    scenes.check_labels(confs("pa/images", "pb/images", "pa/images"))
    with pytest.raises(XrgsError, match=r"pa/other and .*pb/other: both are called other"):
        scenes.check_labels(confs("pa/other", "pb/other"))
