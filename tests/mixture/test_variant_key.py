"""Keys of variants: which code and which settings they have."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from tests.photos.scene_confs import scene_conf
from xrgs.config import VariantConf
from xrgs.mixture import degradations, tags, variant
from xrgs.photos import scenes
from xrgs.safeio import code

Make = Callable[..., VariantConf]
SCENE = scene_conf("motorcycle", name="motorcycle")
#: Settings that use each part of the code once or not at all.
CHANGES = {
    "downsample": {"degradation": "downsample"},
    "jpeg": {"degradation": "jpeg"},
    "digital_zoom": {"degradation": "digital_zoom"},
    "box": {"degradation": "box"},
    "lanczos": {"degradation": "lanczos"},
    "phone": {"degradation": "phone"},
    "megapixels": {"tags": "megapixels", "degradation": "none"},
    "distance": {"tags": "distance", "degradation": "none"},
    "sampling_rate": {"tags": "sampling_rate", "degradation": "none"},
}


@pytest.fixture
def keys(configured: Make) -> Callable[[], dict[str, str]]:
    """() -> the keys of a variant of each of `CHANGES`."""

    def of_all() -> dict[str, str]:
        return {name: variant.key(SCENE, configured(**change)) for name, change in CHANGES.items()}

    return of_all


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of the package's source files, from which digests are made."""
    copy = tmp_path / "xrgs"
    for folder in ("mixture", "photos"):
        shutil.copytree(code.PACKAGE / folder, copy / folder)
    monkeypatch.setattr(code, "PACKAGE", copy)
    return copy


def add_to(file: Path) -> None:
    """Add a line of code at the end of a file."""
    with file.open("a") as stream:
        stream.write("\nMORE = 1\n")


def test_every_file_of_photos_and_mixture_counts_always_or_with_a_part(
    configured: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Registries and downloads don't count."""
    counted: set[str] = set()

    def digest_files(files: dict[str, Path]) -> str:
        counted.update(files)
        return "digest"

    monkeypatch.setattr(code, "digest_files", digest_files)
    for change in CHANGES.values():
        variant.all_code(SCENE, configured(**change, poses="anything"))
    for kind in scenes.KINDS:
        scenes.code_of(kind)
    files = {
        file.relative_to(code.PACKAGE).as_posix()
        for name in ("mixture", "photos")
        for file in (code.PACKAGE / name).rglob("*.py")
    }
    assert files - counted == {
        "mixture/degradations/__init__.py",
        "mixture/tags/__init__.py",
        "photos/scenes/kinds.py",
        *(f"photos/download/{name}.py" for name in ("__init__", "http", "scenes")),
    }


def test_a_file_that_is_added_counts_where_its_folder_does(configured: Make, package: Path) -> None:
    before = variant.key(SCENE, configured())
    for name, counts in {
        "mixture/new.py": True,
        "photos/new.py": True,
        "mixture/poses/new.py": False,
        "mixture/tags/new.py": False,
        "photos/scenes/new.py": False,
        "photos/download/new.py": False,
        "new.py": False,
    }.items():
        (package / name).write_text("MORE = 1\n")
        assert (variant.key(SCENE, configured()) != before) == counts, name
        (package / name).unlink()


def test_a_kind_of_scenes_counts_where_it_is_on(configured: Make, package: Path) -> None:
    before, procedural = variant.key(SCENE, configured()), scenes.code_of("procedural")
    add_to(package / "photos/scenes/still_life.py")  # that the procedural scene imports
    assert variant.key(SCENE, configured()) == before
    assert scenes.code_of("procedural") != procedural
    add_to(package / "photos/scenes/motorcycle.py")
    assert variant.key(SCENE, configured()) != before


def test_the_code_of_a_part_changes_the_keys_that_use_it(
    keys: Callable[[], dict[str, str]], package: Path
) -> None:
    assert CHANGES.keys() == degradations.DEGRADATIONS.keys() | tags.POLICIES.keys()
    before = keys()
    assert len(set(before.values())) == len(CHANGES)
    for part, folder in (("jpeg", "degradations"), ("distance", "tags")):
        add_to(package / "mixture" / folder / f"{part}.py")
    changed = keys()
    assert {name for name in CHANGES if changed[name] != before[name]} == {"jpeg", "distance"}


def test_the_core_changes_every_key_and_poses_those_of_given_poses(
    package: Path, configured: Make, tmp_path: Path
) -> None:
    for name in ("cameras", "images", "points3D"):
        (tmp_path / f"{name}.txt").write_text("")
    confs = configured(), configured(poses=str(tmp_path))
    before, before_given = (variant.key(SCENE, conf) for conf in confs)
    add_to(package / "mixture/poses/colmap.py")
    assert variant.key(SCENE, confs[0]) == before
    assert variant.key(SCENE, confs[1]) != before_given
    add_to(package / "photos/lens.py")
    assert variant.key(SCENE, confs[0]) != before


def test_settings_of_a_degradation_are_in_the_keys_that_use_it(configured: Make) -> None:
    phone = configured().phone
    changes: dict[str, dict[str, Any]] = {
        "jpeg": {"jpeg_quality": 11},
        "phone": {"phone": replace(phone, blur=1.0)},
    }
    for used, change in changes.items():
        for name in ("downsample", used):
            before, after = (
                variant.key(SCENE, configured(degradation=name, **more)) for more in ({}, change)
            )
            assert (before != after) == (name == used)
    automatic, named = configured(), configured(degradation="downsample")
    assert variant.key(SCENE, automatic) == variant.key(SCENE, named)
