"""The texture of photographs, which stays where they are removed."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from tests.store.cells import finished, identity, write_variant
from xrgs.errors import StoreError
from xrgs.store.archive import import_store, pack
from xrgs.store.store import Store
from xrgs.store.trimming import TEXTURES, home_of, texture, textures, trim_variant
from xrgs.training.components.texture import gradient_magnitude


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
