"""Frozen variants: written, verified and loaded; damaged and unreadable ones are named."""

from __future__ import annotations

import dataclasses
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from xrgs.errors import UnreadableError
from xrgs.mixture import saved_variant
from xrgs.mixture.saved_variant import CorruptVariant
from xrgs.mixture.views import Variant, View
from xrgs.photos import images
from xrgs.safeio import checksums

Edit = Callable[[dict[str, Any]], object]
Write = Callable[..., Path]
_COLORS = np.zeros((5, 3), np.uint8)


def make(folder: Path) -> Variant:
    """A variant of two views, whose images are in `work`."""
    work, views = folder / "work", []
    for split, name in (("test", "a"), ("train", "b")):
        file = work / f"images/{split}/{name}.png"
        file.parent.mkdir(parents=True)
        Image.new("RGB", (4, 3)).save(file)
        views.append(View(name, file, split, "HR", 4, 3, np.eye(3), np.eye(4), 1.0))
    return Variant("", work, "scene", 5, True, tuple(views), np.ones((5, 3)), _COLORS, {})


@pytest.fixture(scope="module")
def intact(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a frozen variant that no test changes."""
    home = tmp_path_factory.mktemp("intact")
    made = make(home)
    return saved_variant.freeze(made, "key", made.folder, home, {}).folder


@pytest.fixture
def write(intact: Path, tmp_path: Path) -> Write:
    """(change of `variant.json`, arrays of the points) -> the folder of a variant with a right id.

    Without a change it is a copy of the intact one.
    """

    def changed(edit: Edit = lambda _: None, **arrays: Any) -> Path:
        folder = shutil.copytree(intact, tmp_path / "work")
        file = folder / "variant.json"
        content = json.loads(file.read_text())
        edit(content)
        if arrays:
            np.savez(folder / "points.npz", **arrays)
            content["files"].update(checksums.hashes(folder, ["points.npz"]))
        content["id"] = variant_id(content)
        file.write_text(json.dumps(content))
        return folder.rename(tmp_path / content["id"])

    return changed


def variant_id(content: dict[str, Any]) -> str:
    """The right id of a list of views, and any id where its types are wrong."""
    import msgspec

    try:
        return msgspec.convert(content, saved_variant.Manifest).computed_id()
    except msgspec.ValidationError:
        return str(content["id"])


def test_a_mask_is_hashed_and_a_variant_without_masks_has_no_word_of_them(tmp_path: Path) -> None:
    plain, masked = (make(tmp_path / name) for name in ("plain", "masked"))
    file = masked.folder / "images/test-masks/a.png"
    images.save_mask(file, np.ones((3, 4), np.bool_))
    views = (dataclasses.replace(masked.views[0], mask=file), masked.views[1])
    masked = dataclasses.replace(masked, views=views)
    first, second = (
        saved_variant.freeze(made, "key", made.folder, tmp_path, {}) for made in (plain, masked)
    )
    assert "mask" not in (first.folder / "variant.json").read_text()
    assert first.id != second.id
    mask = second.folder / "images/test-masks/a.png"
    assert [view.mask for view in saved_variant.load(second.folder).views] == [mask, None]
    images.save_mask(mask, np.zeros((3, 4), np.bool_))
    with pytest.raises(CorruptVariant, match=r"test-masks/a\.png: it has changed"):
        saved_variant.load(second.folder)


def first_view(**changes: Any) -> Edit:
    return lambda content: content["views"][0].update(changes)


@pytest.mark.parametrize(
    ("edit", "named"),
    [
        (first_view(width=0), r"views\[0\]\.width: Expected `int` >= 1"),
        (first_view(tag="x"), r"views\[0\]\.tag: Invalid enum value"),
        (first_view(rho=0), r"views\[0\]\.rho: Expected `float` > 0"),
        (first_view(K=[[1, 2], [3]]), r"views\[0\]\.K\[0\]: Expected `array` of length >= 3"),
        (first_view(mask="images/test-masks/a.png"), "files: they are not the view"),
        (first_view(more=1), r"views\[0\]: Object contains unknown field `more`"),
        (lambda content: content.pop("key"), "missing required field `key`"),
        (lambda content: content["files"].pop("images/test/a.png"), "files: they are not the view"),
        (lambda content: content["views"].append(content["views"][0]), "two of a split have one"),
        (lambda content: content["views"][1].update(split="original"), "none is to train"),
    ],
)
def test_a_wrong_value_in_the_list_is_named(write: Write, edit: Edit, named: str) -> None:
    folder = write(edit)
    with pytest.raises(CorruptVariant, match=rf"damaged: {folder}/variant\.json: .*{named}"):
        saved_variant.load(folder)
    (line,) = saved_variant.verify(folder)
    assert str(folder) in line


@pytest.mark.parametrize(
    "arrays",
    [
        {"points": np.full((5, 3), np.nan), "colors": _COLORS},
        {"points": np.ones((5, 3), np.float32), "colors": _COLORS},
        {"points": np.ones((3, 3)), "colors": _COLORS[:3]},
        {"points": np.ones((5, 3)), "colors": np.zeros((3, 3), np.uint8)},
        {"points": np.ones((5, 3)), "colors": np.zeros((5, 3))},
        {"points": np.ones((5, 3))},
    ],
)
def test_wrong_points_are_refused(write: Write, arrays: dict[str, Any]) -> None:
    with pytest.raises(CorruptVariant, match=r"damaged: .*points\.npz: "):
        saved_variant.load(write(**arrays))


def test_a_variant_is_known_by_the_name_of_its_folder(
    write: Write, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = write()
    assert [view.name for view in saved_variant.load(folder).views] == ["a", "b"]
    (tmp_path / "link").symlink_to(folder)
    assert saved_variant.load(tmp_path / "link").id == folder.name  # a user may name it by a link
    monkeypatch.chdir(folder)
    assert saved_variant.load(Path()).id == folder.name
    shutil.copytree(folder, tmp_path / "key-other")
    with pytest.raises(CorruptVariant, match=f"key-other: .*another name than .*{folder.name}"):
        saved_variant.load(tmp_path / "key-other")
    trimmed = shutil.copytree(folder, tmp_path / f"trimmed-{folder.name}")
    assert saved_variant.read_manifest(trimmed).id == folder.name
    file = folder / "variant.json"
    file.write_text(file.read_text().replace('"factor": 5', '"factor": 4'))
    with pytest.raises(CorruptVariant, match=r"variant\.json: it has changed"):
        saved_variant.load(folder)


def test_verifying_names_every_file_that_is_not_as_it_was(write: Write) -> None:
    folder = write()
    assert saved_variant.verify(folder) == []
    (folder / "images/test/a.png").unlink()
    (folder / "images/train/b.png").write_bytes(b"changed")
    (folder / "notes.txt").write_text("mine")
    (folder / "colmap.log").write_text("belongs there")
    assert saved_variant.verify(folder) == [
        f"{folder}/images/test/a.png: No such file or directory",
        f"{folder}/images/train/b.png: it has changed since it was written",
        f"{folder}/notes.txt: it does not belong there",
    ]
    (folder / "variant.json").unlink()
    assert saved_variant.verify(folder) == [f"{folder}/variant.json: No such file or directory"]


@pytest.mark.parametrize("name", ["points.npz", "images/test/a.png", "report.json"])
def test_a_file_that_cant_be_read_now_says_nothing_of_the_variant(
    write: Write, name: str, unreadable: Callable[[str], None]
) -> None:
    folder = write()
    unreadable(name)
    with pytest.raises(UnreadableError, match=f"{name}: Input/output error; try again"):
        saved_variant.load(folder)
    (line,) = saved_variant.verify(folder)
    assert f"{name}: Input/output error" in line


def test_folders_are_set_aside_under_names_that_are_free(tmp_path: Path) -> None:
    folder = tmp_path / "key-hash"
    (tmp_path / ".key-hash.aside-2").write_text("a file")
    for number in (1, 3):
        folder.mkdir()
        (folder / "content").write_text(str(number))
        assert checksums.set_aside(folder).name == f".key-hash.aside-{number}"
        assert (tmp_path / f".key-hash.aside-{number}/content").read_text() == str(number)
        assert not folder.exists()
