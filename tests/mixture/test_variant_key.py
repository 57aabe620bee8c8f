"""Keys of variants: which code and which settings they have."""

from __future__ import annotations

import ast
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from tests.photos.scene_confs import scene_conf
from xrgs.config import VariantConf
from xrgs.mixture import degradations, tags, variant
from xrgs.photos import scenes
from xrgs.safeio import code

if TYPE_CHECKING:
    from xrgs.photos.images import ImageArray

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
    shutil.copytree(code.PACKAGE / "capture", copy / "capture")
    monkeypatch.setattr(code, "PACKAGE", copy)
    return copy


def imported_modules(file: Path) -> set[str]:
    """The files in capture/ that a file imports, at its top, in a function or for types alone."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("xrgs.capture"):
            for alias in node.names:
                parts = f"{node.module}.{alias.name}".split(".")[1:]
                while not (code.PACKAGE / "/".join(parts)).with_suffix(".py").is_file():
                    if (code.PACKAGE / "/".join(parts) / "__init__.py").is_file():
                        parts.append("__init__")
                    else:
                        parts.pop()
                found.add("/".join(parts) + ".py")
    return found


def test_the_code_of_a_key_is_all_that_making_a_variant_imports(configured: Make) -> None:
    """Scenes have fingerprints; registries, notes and reports of failed scenes decide no image."""
    not_covered = {
        "capture/__init__.py",
        "mixture/blur.py",
        "mixture/degradations/__init__.py",
        "mixture/paths.py",
        "mixture/tags/__init__.py",
    }
    reached: set[str] = set()
    pending = {"mixture/variant.py"}
    while pending:
        file = pending.pop()
        reached.add(file)
        pending |= {
            name
            for name in imported_modules(code.PACKAGE / file)
            if not name.startswith("photos/scenes/")
        } - reached
    covered: set[str] = set()
    for change in CHANGES.values():
        for files in variant.sources(configured(**change, poses="anything")).values():
            covered.update(files)
    assert "photos/lens.py" in reached
    assert covered == reached - not_covered


def test_each_degradation_and_policy_has_a_module_of_its_name(configured: Make) -> None:
    assert CHANGES.keys() == degradations.DEGRADATIONS.keys() | tags.POLICIES.keys()
    assert not variant.sources(configured(degradation="none")).keys() - {"core"}
    for name, change in CHANGES.items():
        (file,) = variant.sources(configured(**change)).keys() - {"core"}
        assert variant.sources(configured(**change))[file][0].endswith(f"/{name}.py")


def test_the_code_of_a_part_changes_the_keys_that_use_it(
    keys: Callable[[], dict[str, str]], package: Path
) -> None:
    before = keys()
    assert len(set(before.values())) == len(CHANGES)
    for part, folder in (("jpeg", "degradations"), ("distance", "tags")):
        file = package / "capture" / folder / f"{part}.py"
        whole = file.read_text()
        file.write_text(f"{whole}\nLATER = 1\n")
        changed = keys()
        assert {name for name in CHANGES if changed[name] != before[name]} == {part}
        file.write_text(f"# A comment\n{whole}")
        assert keys() == before


def test_the_core_changes_every_key_and_poses_those_of_given_poses(
    keys: Callable[[], dict[str, str]], package: Path, configured: Make, tmp_path: Path
) -> None:
    for name in ("cameras", "images", "points3D"):
        (tmp_path / f"{name}.txt").write_text("")
    given = configured(poses=str(tmp_path))
    before, before_given = keys(), variant.key(SCENE, given)
    with (package / "mixture/poses/colmap.py").open("a") as stream:
        stream.write("LATER = 1\n")
    assert keys() == before
    assert variant.key(SCENE, given) != before_given
    with (package / "photos/lens.py").open("a") as stream:
        stream.write("LATER = 1\n")
    assert not set(keys().values()) & set(before.values())


def test_what_is_added_changes_no_key(
    keys: Callable[[], dict[str, str]],
    package: Path,
    configured: Make,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A scene kind, a degradation and a policy: a file and a line each, and they can be used."""
    before = keys()

    def blur(high: ImageArray, conf: VariantConf, rng: np.random.Generator) -> ImageArray:
        return high

    (package / "mixture/degradations/blur.py").write_text("def blur(): ...")
    (package / "mixture/tags/age.py").write_text("class Age: ...")
    monkeypatch.setitem(degradations.DEGRADATIONS, "blur", degradations.Degradation(blur))
    monkeypatch.setitem(tags.POLICIES, "age", tags.POLICIES["megapixels"])
    monkeypatch.setitem(scenes.KINDS, "another", scenes.KINDS["motorcycle"])
    assert keys() == before
    added = {
        variant.key(SCENE, configured(degradation="blur")),
        variant.key(SCENE, configured(tags="age")),
        variant.key(replace(SCENE, kind="another"), configured()),
    }
    assert len(added) == 3
    assert not added & set(before.values())


def test_settings_of_a_degradation_are_in_the_keys_that_use_it(configured: Make) -> None:
    phone = configured().phone
    changes: dict[str, dict[str, Any]] = {
        "jpeg": {"jpeg_quality": 11},
        "phone": {"phone": replace(phone, blur=1.0)},
    }
    for used, change in changes.items():
        for name in degradations.DEGRADATIONS:
            before, after = (
                variant.key(SCENE, configured(degradation=name, **more)) for more in ({}, change)
            )
            assert (before != after) == (name == used)
    for other in (replace(phone, noise=0.0), replace(phone, jpeg_quality=90)):
        changed = configured(degradation="phone", phone=other)
        assert variant.key(SCENE, changed) != variant.key(SCENE, configured(degradation="phone"))


def test_automatic_and_named_degradations_are_one_variant(configured: Make) -> None:
    assert variant.key(SCENE, configured()) == variant.key(
        SCENE, configured(degradation="downsample")
    )
