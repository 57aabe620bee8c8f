"""Tests of cells and variants whose heavy files were removed on purpose."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from tests.store.cells import finished, identity, write_variant
from xrgs.config import Conf
from xrgs.errors import StoreError, UnreadableError
from xrgs.safeio.files import list_names
from xrgs.safeio.hashing import file_digest
from xrgs.store import trimming
from xrgs.store.archive import import_store, pack
from xrgs.store.attempts import remove_cell
from xrgs.store.cell_folder import CellFolder
from xrgs.store.store import Store
from xrgs.store.trimming import TEXTURES, home_of, texture, textures, trim_variant
from xrgs.training.components.weighting import gradient_magnitude

HEAVY = ("renders/a.png", "renders/b.png", "splats.ply")
BYTES = 20
#: The files of a trimmed variant.
KEPT = ["points.npz", "report.json", "textures.json", "variant.json"]


@pytest.fixture
def cell(tmp_path: Path) -> CellFolder:
    """A done cell with three heavy files."""
    return finished(CellFolder(tmp_path / "cells" / "c"))


def test_a_trimmed_cell_is_done_and_says_what_it_lacks(cell: CellFolder) -> None:
    hashes = {name: file_digest(cell.path / name) for name in HEAVY}
    assert cell.heavy_bytes() == BYTES
    cell.trim()
    assert cell.state().name == "done"
    assert cell.verify() == []
    assert cell.heavy_bytes() == 0
    trimmed = cell.status().trimmed
    assert {name: of.sha256 for name, of in trimmed.items()} == hashes
    assert not (cell.path / "renders").exists()
    with pytest.raises(StoreError, match=r"cells/c/splats\.ply was removed by xrgs-store trim"):
        cell.gaussians()
    cell.check_not_trimmed("scores.csv")
    cell.trim()
    assert cell.status().trimmed == trimmed


def test_a_trim_that_was_killed_midway_is_done_and_is_completed(
    cell: CellFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    def killed(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(Path, "unlink", killed)
        with pytest.raises(KeyboardInterrupt):
            cell.trim()
    assert (cell.path / "splats.ply").exists()
    assert cell.state().name == "done"
    assert cell.verify() == []
    assert cell.heavy_bytes() == BYTES
    cell.trim()
    assert cell.heavy_bytes() == 0


def test_a_status_that_names_files_elsewhere_is_refused(cell: CellFolder) -> None:
    (cell.path.parent / "other").write_text("kept")
    status = json.loads(cell.status_file.read_text())
    status["trimmed"] = {"../other": {"bytes": 4, "sha256": "0"}}
    cell.status_file.write_text(json.dumps(status))
    with pytest.raises(StoreError, match=r"status\.json: key in trimmed: not a name"):
        cell.trim()
    assert (cell.path.parent / "other").read_text() == "kept"
    cell.fail("out of luck")
    with pytest.raises(StoreError, match="the cell is not done"):
        cell.trim()
    assert (cell.path / "splats.ply").exists()
    remove_cell(cell)
    assert [path.name for path in cell.path.parent.iterdir()] == ["other"]
    assert cell.state().name == "absent"


@pytest.fixture
def variants(tmp_path: Path) -> Path:
    """The folder of the variants of a store, with one."""
    store = Store(tmp_path)
    store.prepare()
    write_variant(store.variants, "key")
    return store.variants


def test_a_trimmed_variant_keeps_its_list_and_is_found_by_its_key(variants: Path) -> None:
    (name,) = list_names(variants)
    assert trimming.trimmed_variant(variants, "key") is None
    assert trimming.image_bytes(variants, name) == 10
    trimming.check_images(variants, name)
    trimming.trim_variant(variants, name)
    trimming.trim_variant(variants, name)
    assert list_names(variants) == [f"trimmed-{name}"]
    folder = variants / f"trimmed-{name}"
    assert list_names(folder) == KEPT
    assert trimming.verify_variant(folder) == []
    assert trimming.trimmed_variant(variants, "key") == name
    assert trimming.image_bytes(variants, name) == 0
    with pytest.raises(StoreError, match=f"variant {name}: its images were removed"):
        trimming.check_images(variants, name)
    (folder / "points.npz").write_bytes(b"others")
    assert "points.npz: it has changed" in trimming.verify_variant(folder)[0]


# images that are made again


@pytest.fixture
def trimmed(variants: Path) -> str:
    """The id of a variant that was trimmed."""
    (name,) = list_names(variants)
    trimming.trim_variant(variants, name)
    return name


@pytest.fixture
def again(
    variants: Path, compose: Callable[..., Conf], monkeypatch: pytest.MonkeyPatch
) -> Callable[..., None]:
    """(id, error=None) -> restores a variant, whose images are written here; or fails after one."""

    def run(variant_id: str, error: BaseException | None = None) -> None:
        def images(folder: Path, *_: object) -> None:
            (folder / "images").mkdir()
            (folder / "images" / "a.png").write_bytes(b"image")
            if error:
                raise error

        monkeypatch.setattr(trimming, "restore_images", images)
        conf = compose("scene=motorcycle")
        trimming.restore_variant(variants, variant_id, conf.scene, conf.variant, variants)

    return run


def names(folder: Path) -> list[str]:
    return [name for name in list_names(folder) if not name.endswith(".lock")]


def test_a_restored_variant_has_its_name_and_its_images(
    variants: Path, trimmed: str, again: Callable[..., None]
) -> None:
    again(trimmed)
    assert names(variants) == [trimmed]
    assert (variants / trimmed / "images" / "a.png").read_bytes() == b"image"
    trimming.check_images(variants, trimmed)
    again(trimmed, AssertionError("nothing is made of one that has its images"))
    assert names(variants) == [trimmed]


def test_images_that_cant_be_made_again_leave_the_variant_trimmed(
    variants: Path, trimmed: str, again: Callable[..., None]
) -> None:
    with pytest.raises(StoreError, match=rf"variant {trimmed}: .* made again: another image\. Rem"):
        again(trimmed, StoreError("another image"))
    assert names(variants) == [f"trimmed-{trimmed}"]
    assert list_names(variants / f"trimmed-{trimmed}") == KEPT
    with pytest.raises(UnreadableError, match="a server is away"):
        again(trimmed, UnreadableError("a server is away"))
    assert list_names(variants / f"trimmed-{trimmed}") == KEPT


def test_a_restoration_that_was_killed_midway_is_begun_again(
    variants: Path, trimmed: str, again: Callable[..., None]
) -> None:
    with pytest.raises(KeyboardInterrupt):
        again(trimmed, KeyboardInterrupt())
    (variants / f".{trimmed}.restoring").mkdir()
    assert trimming.trimmed_variant(variants, "key") == trimmed
    again(trimmed)
    assert names(variants) == [trimmed]


def test_texture_is_the_mean_of_the_gradient_that_components_use() -> None:
    image = np.random.default_rng(0).uniform(size=(37, 53, 3)).astype(np.float32)
    magnitude = gradient_magnitude(torch.from_numpy(image).double())[:-1, :-1]
    assert texture(image) == pytest.approx(float(magnitude.mean()), rel=1e-12)
    ramp = np.broadcast_to(np.linspace(0, 1, 11, dtype=np.float32)[None, :, None], (7, 11, 3))
    assert texture(ramp) == pytest.approx(0.1, rel=1e-6)  # its slope
    assert math.isnan(texture(np.zeros((9, 1, 3), np.float32)))


@pytest.fixture
def variant(tmp_path: Path) -> Path:
    """A variant whose only readable photograph, `test/b`, has stripes of 51 / 255."""
    store = Store(tmp_path / "s")
    store.prepare()
    folder = store.variant(write_variant(store.variants))
    image = np.full((20, 30, 3), 100, np.uint8)
    image[:, ::2] += np.uint8(51)
    Image.fromarray(image).save(folder / "images" / "test" / "b.png")
    return folder


def test_a_masked_photograph_has_the_texture_of_the_used_part(variant: Path) -> None:
    image = np.zeros((20, 30, 3), np.uint8)
    image[:, 15:] = np.random.default_rng(0).integers(256, size=(20, 15, 3))
    Image.fromarray(image).save(variant / "images" / "test" / "b.png")
    (variant / "images" / "test-masks").mkdir()
    mask = np.zeros((20, 30), np.uint8)
    mask[:, 15:] = 255
    Image.fromarray(mask).save(variant / "images" / "test-masks" / "b.png")
    part = (image[:, 15:] / 255).astype(np.float32)
    assert textures(variant) == {"test/b": pytest.approx(texture(part), rel=1e-6)}


def test_a_trimmed_variant_keeps_its_textures(variant: Path) -> None:
    kept = {"test/b": pytest.approx(0.2)}
    assert textures(variant, ["test/b", "train/a"]) == kept  # train/a is no PNG
    trim_variant(variant.parent, variant.name)
    trim_variant(variant.parent, variant.name)
    assert textures(home_of(variant.parent, variant.name)) == kept


@pytest.mark.parametrize("is_trimmed", [False, True])
def test_a_pack_has_the_textures_and_an_import_takes_them(
    variant: Path, tmp_path: Path, is_trimmed: bool
) -> None:
    store, other = Store(tmp_path / "s"), Store(tmp_path / "o")
    finished(store.cell("c"), None, identity(0, variant.name))
    if is_trimmed:
        trim_variant(variant.parent, variant.name)
    pack(store, store.cell_folders(), tmp_path / "a.tar.xz", tmp_path)
    import_store(tmp_path / "a.tar.xz", other)
    assert textures(home_of(other.variants, variant.name)) == {"test/b": pytest.approx(0.2)}


def test_damaged_textures_are_not_imported(variant: Path, tmp_path: Path) -> None:
    store = Store(tmp_path / "s")
    trim_variant(variant.parent, variant.name)
    (variant.parent / f"trimmed-{variant.name}" / TEXTURES).write_text('{"test/b": "much"}')
    with pytest.raises(StoreError, match="damaged"):
        textures(home_of(variant.parent, variant.name))
    found = import_store(store.path, Store(tmp_path / "o"))
    assert found.variants == 0
    assert TEXTURES in found.left_out[0]
