"""Keys of variants: which code and which settings they have."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from tests.photos.scene_confs import scene_conf
from xrgs.config import VariantConf
from xrgs.mixture import degradations, poses, tags, variant
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
    for folder in ("mixture", "photos"):
        shutil.copytree(code.PACKAGE / folder, copy / folder)
    monkeypatch.setattr(code, "PACKAGE", copy)
    return copy


def add_to(file: Path) -> None:
    """Add a line of code at the end of a file."""
    with file.open("a") as stream:
        stream.write("\nMORE = 1\n")


@pytest.mark.slow
def test_every_file_of_photos_and_mixture_counts_always_or_with_a_part(
    package: Path, configured: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A line of code at the end of each file in turn; registries and downloads don't count."""
    monkeypatch.setattr(poses, "fingerprint", lambda _: "poses")

    confs = [configured(**change, poses="anything") for change in CHANGES.values()]
    codes: list[Callable[[], object]] = [
        *(partial(variant.all_code, SCENE, conf) for conf in confs),
        *(partial(scenes.code_of, kind) for kind in scenes.KINDS),
    ]
    before, uncounted = [code() for code in codes], set()
    for file in [file for name in ("mixture", "photos") for file in (package / name).rglob("*.py")]:
        text = file.read_text()
        add_to(file)
        if all(code() == expected for code, expected in zip(codes, before, strict=True)):
            uncounted.add(file.relative_to(package).as_posix())
        file.write_text(text)
    assert uncounted == {
        "mixture/degradations/__init__.py",
        "mixture/tags/__init__.py",
        "photos/scenes/kinds.py",
        *(f"photos/download/{name}.py" for name in ("__init__", "http", "scenes", "unpack")),
    }


@pytest.mark.parametrize(
    ("name", "counts"),
    [
        ("mixture/new.py", True),
        ("photos/new.py", True),
        ("mixture/poses/new.py", False),
        ("mixture/degradations/new.py", False),
        ("mixture/tags/new.py", False),
        ("photos/scenes/new.py", False),
        ("photos/download/new.py", False),
        ("new.py", False),
    ],
)
def test_a_file_that_is_added_counts_where_its_folder_does(
    keys: Callable[[], dict[str, str]], package: Path, name: str, counts: bool
) -> None:
    before = keys()
    (package / name).write_text("MORE = 1\n")
    changed = {name for name, key in keys().items() if key != before[name]}
    assert changed == (set(CHANGES) if counts else set())


def test_a_kind_of_scenes_counts_where_it_is_on(
    keys: Callable[[], dict[str, str]], package: Path
) -> None:
    before, procedural = keys(), scenes.code_of("procedural")
    add_to(package / "photos/scenes/still_life.py")  # that the procedural scene imports
    assert keys() == before
    assert scenes.code_of("procedural") != procedural
    add_to(package / "photos/scenes/motorcycle.py")
    assert not set(keys().values()) & set(before.values())


def test_each_degradation_and_policy_has_a_module_of_its_name(configured: Make) -> None:
    assert CHANGES.keys() == degradations.DEGRADATIONS.keys() | tags.POLICIES.keys()
    for part, names in (("degradations", degradations.DEGRADATIONS), ("tags", tags.POLICIES)):
        assert all((code.PACKAGE / f"mixture/{part}/{name}.py").is_file() for name in names)
    assert not variant.code(configured(degradation="none")).keys() - {"core"}
    assert {name for change in CHANGES.values() for name in variant.code(configured(**change))} == {
        "core",
        "degradation",
        "tags",
    }


def test_the_code_of_a_part_changes_the_keys_that_use_it(
    keys: Callable[[], dict[str, str]], package: Path
) -> None:
    before = keys()
    assert len(set(before.values())) == len(CHANGES)
    for part, folder in (("jpeg", "degradations"), ("distance", "tags")):
        file = package / "mixture" / folder / f"{part}.py"
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
    (package / "photos/scenes/another.py").write_text("class Another: ...")
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
