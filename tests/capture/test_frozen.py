"""Forged, damaged and unreadable variants: none is trusted, and nothing outside them is read."""

from __future__ import annotations

import errno
import json
import os
import resource
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from PIL import Image

from xrgs.capture import frozen, sealed
from xrgs.capture.frozen import CorruptVariant
from xrgs.capture.views import Variant, View
from xrgs.errors import UnreadableError
from xrgs.safeio import confined, npz
from xrgs.safeio.confined import ConfinedPath

Forge = Callable[..., Path]
Edit = Callable[[dict[str, Any]], object]
_COLORS = np.zeros((5, 3), np.uint8)


def make(folder: Path) -> Variant:
    """A variant of two views, whose images are in `work`."""
    work = ConfinedPath(folder) / "work"
    views = []
    for split, name in (("test", "a"), ("train", "b")):
        file = work / f"images/{split}/{name}.png"
        file.path.parent.mkdir(parents=True)
        Image.new("RGB", (4, 3)).save(file.path)
        views.append(View(name, file, split, "HR", 4, 3, np.eye(3), np.eye(4), 1.0))
    return Variant("", work, "scene", 5, True, tuple(views), np.ones((5, 3)), _COLORS, {})


@pytest.fixture(scope="module")
def intact(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a frozen variant that no test changes."""
    home = ConfinedPath(tmp_path_factory.mktemp("intact"))
    made = make(home.path)
    return frozen.freeze(made, "key", made.folder, home).path


@pytest.fixture
def forge(intact: Path, tmp_path: Path) -> Forge:
    """(change of the content of variant.json, fields) -> the folder of a variant with a right id.

    The change is made before the id is computed, as a forger does.
    """

    def freeze(edit: Edit = lambda _: None, **fields: Any) -> Path:
        folder = shutil.copytree(intact, tmp_path / "work")
        file = folder / "variant.json"
        content = json.loads(file.read_text())
        edit(content)
        if fields:
            np.savez(folder / "points.npz", **fields)
            digest = sealed.hashes(ConfinedPath(folder), ["points.npz"])
            content["files"].update(digest)
        if isinstance(content.get("key"), str):
            content["id"] = frozen.variant_id(content)
        file.write_text(json.dumps(content))
        return folder.rename(tmp_path / str(content.get("id", "none")).replace("/", "_")[:200])

    return freeze


def test_a_variant_with_right_values_is_loaded(forge: Forge) -> None:
    folder = forge()
    assert [view.name for view in frozen.load(folder).views] == ["a", "b"]
    assert frozen.verify(folder) == []


def first_view(**changes: Any) -> Edit:
    return lambda content: content["views"][0].update(changes)


def of(**changes: Any) -> Edit:
    return lambda content: content.update(changes)


def matrix(side: int, value: Any) -> list[list[Any]]:
    return [[value] * side] * side


@pytest.mark.parametrize(
    ("edit", "named"),
    [
        (first_view(name="../../../evil"), "name of view 0"),
        (first_view(name="/evil"), "name of view 0"),
        (first_view(name="a\nb"), "name of view 0"),
        (first_view(name=1), "name of view 0"),
        (first_view(name=["a"]), "name of view 0"),
        (first_view(split="../x"), "split of view 0"),
        (first_view(split=["test"]), "not a complete variant"),
        (first_view(tag="x"), "tag of view 0"),
        (first_view(tag={}), "not a complete variant"),
        (first_view(file="images/test/b.png"), "file of view 0"),
        (first_view(file={"images": "test"}), "file of view 0"),
        (first_view(width=-4), "width of view 0"),
        (first_view(width=True), "width of view 0"),
        (first_view(width=10**9), "width of view 0"),
        (first_view(height="3"), "height of view 0"),
        (first_view(rho=float("nan")), "rho of view 0"),
        (first_view(rho="1"), "rho of view 0"),
        (first_view(rho=10**400), "rho of view 0"),
        (first_view(K=matrix(3, float("inf"))), "K of view 0"),
        (first_view(K=[[1e308, 0, 1e308], [0, 1e308, 0], [0, 0, 1]]), "K of view 0"),
        (first_view(K=matrix(3, 10**400)), "K of view 0"),
        (first_view(K=matrix(3, "1")), "K of view 0"),
        (first_view(K=matrix(3, 0.0)), "K of view 0"),
        (first_view(K=[[1, 2], [3]]), "K of view 0"),
        (first_view(viewmat=np.eye(3).tolist()), "viewmat of view 0"),
        (first_view(viewmat=(2 * np.eye(4)).tolist()), "viewmat of view 0"),
        (first_view(viewmat=matrix(4, float("nan"))), "viewmat of view 0"),
        (first_view(more=1), "wrong: keys of view 0"),
        (of(factor=0), "wrong: factor"),
        (of(factor=True), "wrong: factor"),
        (of(factor=10**9), "wrong: factor"),
        (of(held_out=1), "wrong: held_out"),
        (of(scene=["x"]), "wrong: scene"),
        (of(scene="a\nb"), "wrong: scene"),
        (of(scene="\x1b[31m"), "wrong: scene"),
        (of(scene="s" * 10_000), "wrong: scene"),
        (of(views=[]), "wrong: views"),
        (of(views={"a": 1}), "wrong: views"),
        (of(views=[[[]]]), "wrong: keys of view 0"),
        (of(views=[0] * 20_000), "wrong: views"),
        (of(files=[]), "wrong: files"),
        (of(files={"points.npz": 1}), "wrong: files"),
        (of(more=1), "wrong: keys more"),
        (of(key=3), "wrong: id"),
        (lambda content: content.pop("key"), "wrong: keys key"),
        (lambda content: content["files"].update({"../secret.png": "0" * 64}), "wrong: files"),
        (lambda content: content["files"].pop("images/test/a.png"), "wrong: files"),
        (
            lambda content: content["views"].append(content["views"][0]),
            "of which two have one name",
        ),
        (lambda content: content["views"].pop(), "wrong: files"),
    ],
)
def test_a_wrong_value_in_the_list_is_refused_and_named(
    forge: Forge, edit: Edit, named: str
) -> None:
    folder = forge(edit)
    with pytest.raises(CorruptVariant, match=r"variant\.json: not a complete variant") as caught:
        frozen.load(folder)
    assert named in str(caught.value)
    assert len(str(caught.value).splitlines()) == 1
    (line,) = frozen.verify(folder)
    assert str(folder) in line


@pytest.mark.parametrize(
    "arrays",
    [
        {"points": np.full((5, 3), np.nan), "colors": _COLORS},
        {"points": np.full((5, 3), 1e308), "colors": _COLORS},
        {"points": np.ones((5, 3), np.float32), "colors": _COLORS},
        {"points": np.ones(15), "colors": _COLORS},
        {"points": np.float64(1), "colors": _COLORS},
        {"points": np.ones((0, 3)), "colors": _COLORS[:0]},
        {"points": np.ones((3, 3)), "colors": _COLORS[:3]},
        {"points": np.ones((5, 3)), "colors": np.zeros((3, 3), np.uint8)},
        {"points": np.ones((5, 3)), "colors": np.zeros((5, 3))},
        {"points": np.ones((5, 3))},
    ],
)
def test_wrong_points_are_refused(forge: Forge, arrays: dict[str, Any]) -> None:
    with pytest.raises(CorruptVariant, match=r"points\.npz: "):
        frozen.load(forge(**arrays))


def test_a_list_that_was_changed_after_freezing_is_refused(forge: Forge) -> None:
    folder = forge()
    file = folder / "variant.json"
    file.write_text(file.read_text().replace('"factor": 5', '"factor": 4'))
    with pytest.raises(CorruptVariant, match=r"variant\.json: it has changed"):
        frozen.load(folder)


def test_a_variant_is_known_by_the_name_of_its_folder(
    forge: Forge, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = forge()
    (tmp_path / "link").symlink_to(folder)
    assert frozen.load(tmp_path / "link").id == folder.name  # a user may name it by a link
    monkeypatch.chdir(folder)
    assert frozen.load(Path()).id == folder.name
    other = shutil.copytree(folder, tmp_path / "key-other")
    for path in (other, ConfinedPath(tmp_path) / "key-other"):
        with pytest.raises(CorruptVariant, match=f"key-other: it holds another.*{folder.name}"):
            frozen.load(path)


def test_an_image_outside_the_folder_is_not_read(forge: Forge, tmp_path: Path) -> None:
    folder = forge()
    picture, secret = folder / "images/test/a.png", tmp_path / "secret.png"
    picture.rename(secret)
    picture.symlink_to(secret)
    with pytest.raises(CorruptVariant, match=r"a\.png: "):
        frozen.load(folder)


@pytest.mark.parametrize("name", ["points.npz", "images/test/a.png", "variant.json", "report.json"])
def test_a_pipe_in_the_place_of_a_file_is_refused_at_once(forge: Forge, name: str) -> None:
    folder = forge()
    (folder / name).unlink()
    os.mkfifo(folder / name)
    with pytest.raises(CorruptVariant, match=f"{name}: not a regular file"):
        frozen.load(folder)


def test_a_sparse_file_is_not_hashed(forge: Forge) -> None:
    folder = forge()
    os.truncate(folder / "points.npz", 1 << 40)
    with pytest.raises(CorruptVariant, match=r"points\.npz: it is larger than"):
        frozen.load(folder)


def test_views_of_more_pixels_than_their_files_can_hold_are_refused(forge: Forge) -> None:
    def enlarge(content: dict[str, Any]) -> None:
        for view in content["views"]:
            view.update(width=1 << 14, height=1 << 14)

    with pytest.raises(CorruptVariant, match=r"variant\.json: its views have 536870912 pixels"):
        frozen.load(forge(enlarge))


def test_verifying_names_every_file_that_is_not_as_it_was(forge: Forge) -> None:
    folder = forge()
    (folder / "images/test/a.png").unlink()
    (folder / "images/train/b.png").write_bytes(b"changed")
    (folder / "notes.txt").write_text("mine")
    (folder / "colmap.log").write_text("belongs there")
    assert frozen.verify(folder) == [
        f"{folder}/images/test/a.png: No such file or directory",
        f"{folder}/images/train/b.png: it has changed since it was written",
        f"{folder}/notes.txt: it does not belong there",
    ]
    (folder / "variant.json").unlink()
    assert frozen.verify(folder) == [f"{folder}/variant.json: No such file or directory"]


@pytest.mark.parametrize("name", ["points.npz", "images/test/a.png", "variant.json", "report.json"])
def test_a_file_that_cant_be_read_now_says_nothing_of_the_variant(
    forge: Forge, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = forge()
    opened = ConfinedPath._open_regular

    def fails(self: ConfinedPath, flags: int) -> int:
        if str(self).endswith(name):
            raise OSError(errno.EIO, os.strerror(errno.EIO), str(self))
        return opened(self, flags)

    monkeypatch.setattr(confined.ConfinedPath, "_open_regular", fails)
    with pytest.raises(UnreadableError, match=f"{name}: Input/output error"):
        frozen.load(folder)
    (line,) = frozen.verify(folder)
    assert f"{name}: Input/output error" in line


def test_a_disk_that_fails_within_the_points_says_nothing_of_the_variant(
    forge: Forge, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = forge()
    failure = OSError(errno.EIO, os.strerror(errno.EIO))
    monkeypatch.setattr(npz, "read", Mock(side_effect=failure))
    with pytest.raises(UnreadableError, match=r"points\.npz: Input/output error; try again"):
        frozen.load(folder)


def test_everything_is_on_the_disk_before_the_variant_has_its_name(
    tmp_path: Path, disk_events: list[str]
) -> None:
    """Each folder that holds a new name is synced before the rename, and the last one after."""
    made = make(tmp_path)
    variant = frozen.freeze(made, "key", made.folder, ConfinedPath(tmp_path))
    named = disk_events.index(f"rename work to {variant.id}")
    assert {"sync work", "sync images", "sync points.npz"} <= set(disk_events[:named])
    assert disk_events[named + 1 :] == [f"sync {tmp_path.name}"]


def test_what_a_forger_declares_is_not_allocated(forge: Forge) -> None:
    """Within 200 MB more than now: 3,000 views of 65,536 px a side would be 12 TB."""

    def enlarge(content: dict[str, Any]) -> None:
        view = content["views"][0]
        for number in range(3_000):
            name = f"v{number}"
            file = f"images/test/{name}.png"
            content["views"].append(view | {"name": name, "file": file, "width": 1 << 16})
            content["files"][file] = "0" * 64

    folder = forge(enlarge)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(CorruptVariant):
        frozen.load(folder)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 200_000  # kB
