"""Tests of cells and variants whose heavy files were removed on purpose."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest

from xrgs.capture import frozen, restore
from xrgs.config import Conf
from xrgs.errors import StoreError, UnreadableError
from xrgs.experiment import trimming
from xrgs.experiment.attempts import begin_attempt, remove_cell
from xrgs.experiment.cell_folder import CellFolder
from xrgs.experiment.store import Store
from xrgs.safeio.confined import ConfinedPath
from xrgs.safeio.hashing import file_digest

FILES = {"splats.ply": b"ply", "renders/a.png": b"png", "scores.csv": b"view,psnr\na,20\n"}


@pytest.fixture
def cell(tmp_path: Path) -> CellFolder:
    """A done cell with two heavy files."""
    folder = CellFolder(tmp_path / "cells" / "c")
    (tmp_path / "cells").mkdir()
    begin_attempt(folder, {}, {"variant": "k-v", "train": {"views": "mixed"}, "seed": 0})
    (folder.path / "renders").mkdir()
    for name, content in FILES.items():
        (folder.path / name).write_bytes(content)
    folder.finish(["a"], 1)
    return folder


def test_a_trimmed_cell_is_done_and_says_what_it_lacks(cell: CellFolder) -> None:
    hashes = {name: file_digest(cell.path / name) for name in FILES}
    assert cell.heavy_bytes() == 6
    cell.trim()
    assert cell.state().name == "done"
    assert cell.verify() == []
    assert cell.heavy_bytes() == 0
    trimmed = cell.trimmed()
    assert {name: of["sha256"] for name, of in trimmed.items()} == {
        name: hashes[name] for name in ("splats.ply", "renders/a.png")
    }
    with pytest.raises(StoreError, match=r"cells/c/splats\.ply was removed by xrgs-store trim"):
        cell.gaussians()
    cell.check_not_trimmed("scores.csv")
    cell.trim()
    assert cell.trimmed() == trimmed


def test_a_trim_that_was_killed_midway_is_done_and_is_completed(
    cell: CellFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    def killed(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(ConfinedPath, "unlink", killed)
        with pytest.raises(KeyboardInterrupt):
            cell.trim()
    assert (cell.path / "splats.ply").exists()
    assert cell.state().name == "done"
    assert cell.verify() == []
    assert cell.heavy_bytes() == 6
    cell.trim()
    assert cell.heavy_bytes() == 0


def test_a_hostile_status_removes_nothing_elsewhere(cell: CellFolder) -> None:
    (cell.path.parent / "other").write_text("kept")
    status = json.loads((cell.path / "status.json").read_text())
    status["trimmed"] = {"../other": {"bytes": 4, "sha256": "0"}, "renders": 3}
    (cell.path / "status.json").write_text(json.dumps(status))
    with pytest.raises(OSError, match="irectory"):  # `renders` is no file
        cell.trim()
    assert (cell.path.parent / "other").read_text() == "kept"


def test_a_cell_that_is_not_done_is_not_trimmed(cell: CellFolder) -> None:
    cell.fail("out of luck")
    with pytest.raises(StoreError, match="the cell is not done"):
        cell.trim()
    assert (cell.path / "splats.ply").exists()


def test_a_removed_cell_is_gone_with_all_of_its_files(cell: CellFolder) -> None:
    remove_cell(cell)
    assert list(cell.path.parent.iterdir()) == []
    assert cell.state().name == "absent"


@pytest.fixture
def variants(tmp_path: Path) -> ConfinedPath:
    """The folder of the variants of a store, with one."""
    store = Store(tmp_path)
    store.prepare()
    folder = store.variants.path / "new"
    (folder / "images").mkdir(parents=True)
    (folder / "images" / "a.png").write_bytes(b"image")
    (folder / "points.npz").write_bytes(b"points")
    files = {"points.npz": file_digest(folder / "points.npz"), "images/a.png": "0"}
    content = {"key": "key", "files": files}
    content["id"] = frozen.variant_id(content)
    (folder / "variant.json").write_text(json.dumps(content))
    folder.rename(folder.with_name(str(content["id"])))
    return store.variants


def test_a_trimmed_variant_keeps_its_list_and_is_found_by_its_key(variants: ConfinedPath) -> None:
    (name,) = variants.names()
    assert trimming.trimmed_variant(variants, "key") is None
    assert trimming.image_bytes(variants, name) == 5
    trimming.check_images(variants, name)
    trimming.trim_variant(variants, name)
    trimming.trim_variant(variants, name)
    assert variants.names() == [f"trimmed-{name}"]
    folder = variants / f"trimmed-{name}"
    assert folder.names() == ["points.npz", "variant.json"]
    assert trimming.verify_variant(folder) == []
    assert trimming.trimmed_variant(variants, "key") == name
    assert trimming.image_bytes(variants, name) == 0
    with pytest.raises(StoreError, match=f"variant {name}: its images were removed"):
        trimming.check_images(variants, name)
    (folder.path / "points.npz").write_bytes(b"others")
    assert "points.npz: it has changed" in trimming.verify_variant(folder)[0]


def test_a_cell_of_a_trimmed_variant_has_no_dataset_and_says_why(
    cell: CellFolder, tmp_path: Path
) -> None:
    (tmp_path / "variants" / "trimmed-k-v").mkdir(parents=True)
    with pytest.raises(StoreError, match="variant k-v: its images were removed"):
        cell.dataset()


# images that are made again


@pytest.fixture
def trimmed(variants: ConfinedPath) -> str:
    """The id of a variant that was trimmed."""
    (name,) = variants.names()
    trimming.trim_variant(variants, name)
    return name


@pytest.fixture
def again(
    variants: ConfinedPath, compose: Callable[..., Conf], monkeypatch: pytest.MonkeyPatch
) -> Callable[..., None]:
    """(id, error=None) -> restores a variant, whose images are written here; or fails after one."""

    def run(variant_id: str, error: BaseException | None = None) -> None:
        def images(folder: ConfinedPath, *_: object) -> None:
            (folder / "images").make_folder()
            (folder.path / "images" / "a.png").write_bytes(b"image")
            if error:
                raise error

        monkeypatch.setattr(restore, "restore_images", images)
        conf = compose("scene=motorcycle")
        trimming.restore_variant(variants, variant_id, conf.scene, conf.variant, variants)

    return run


def names(folder: ConfinedPath) -> list[str]:
    return [name for name in folder.names() if not name.endswith(".lock")]


def test_a_restored_variant_has_its_name_and_its_images(
    variants: ConfinedPath, trimmed: str, again: Callable[..., None]
) -> None:
    again(trimmed)
    assert names(variants) == [trimmed]
    assert (variants / trimmed / "images" / "a.png").read_bytes() == b"image"
    trimming.check_images(variants, trimmed)


def test_a_variant_that_has_its_images_is_left_alone(
    variants: ConfinedPath, trimmed: str, again: Callable[..., None]
) -> None:
    again(trimmed)
    again(trimmed, AssertionError("nothing is made"))
    assert names(variants) == [trimmed]


def test_images_that_cant_be_made_again_leave_the_variant_trimmed(
    variants: ConfinedPath, trimmed: str, again: Callable[..., None]
) -> None:
    with pytest.raises(StoreError, match=rf"variant {trimmed}: .* made again: another image\. Rem"):
        again(trimmed, StoreError("another image"))
    assert names(variants) == [f"trimmed-{trimmed}"]
    assert (variants / f"trimmed-{trimmed}").names() == ["points.npz", "variant.json"]
    with pytest.raises(UnreadableError, match="a server is away"):
        again(trimmed, UnreadableError("a server is away"))
    assert (variants / f"trimmed-{trimmed}").names() == ["points.npz", "variant.json"]


def test_a_restoration_that_was_killed_midway_is_begun_again(
    variants: ConfinedPath, trimmed: str, again: Callable[..., None]
) -> None:
    with pytest.raises(KeyboardInterrupt):
        again(trimmed, KeyboardInterrupt())
    (variants / f".{trimmed}.restoring").make_folder()
    assert trimming.trimmed_variant(variants, "key") == trimmed
    again(trimmed)
    assert names(variants) == [trimmed]
