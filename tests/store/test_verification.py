"""Tests that every file of a store is hashed, and that what is wrong with it is named."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from tests.store.cells import finished, row
from xrgs.errors import StoreError
from xrgs.mixture import variant
from xrgs.photos import scenes
from xrgs.runtime.text import format_size
from xrgs.store.store import Store
from xrgs.store.verification import verify


@pytest.fixture
def store(tmp_path: Path) -> Store:
    """A store with two done cells and the record of a sweep."""
    store = Store(tmp_path / "s")
    store.prepare()
    for name in ("good", "other"):
        (finished(store.cell(name)).path / "log.txt").write_text("20 steps")
    store.write_sweep(["a"], [row("good", "consistency")])
    return store


@pytest.mark.parametrize(("name", "listed"), [("splats.ply", True), ("log.txt", False)])
def test_a_change_that_keeps_the_size_is_found(store: Store, name: str, listed: bool) -> None:
    assert verify(store)[1] == []
    changed = store.cell("good").path / name
    changed.write_text(changed.read_text().replace("20", "99"))
    text, damage = verify(store)
    named = f"{changed}: it has changed since the cell finished"
    assert damage == ([named] if listed else [])
    assert (named in text) == listed


def test_every_file_is_hashed_and_what_was_hashed_is_said(store: Store) -> None:
    text, _ = verify(store)
    paths = [path for name in ("good", "other") for path in store.cell(name).path.rglob("*.*")]
    paths += (store.path / "sweeps").iterdir()
    size = format_size(sum(path.stat().st_size for path in paths))
    assert f"hashed: {len(paths)} files, {size}, in " in text
    assert text.endswith("all of them as they were written")


def test_files_that_do_not_belong_there_missing_ones_and_corrupt_cells_are_damage(
    store: Store,
) -> None:
    good, other = store.cell("good").path, store.cell("other").path
    (good / "extra").mkdir()
    (good / "extra" / "file").write_text("1")
    (other / "scores.csv").unlink()
    (store.path / "cells" / "pipe").mkdir()
    os.mkfifo(store.path / "cells" / "pipe" / "status.json")
    _, damage = verify(store)
    assert damage[:2] == [
        f"{good}/extra/file: it does not belong there",
        f"{other}: scores.csv is missing or has another size",
    ]
    assert damage[2].startswith(f"{store.path}/cells/pipe: ")
    assert len(damage) == 3


def test_a_record_whose_cells_were_changed_is_damage(store: Store, tmp_path: Path) -> None:
    (file,) = (store.path / "sweeps").iterdir()
    file.write_text(file.read_text().replace("consistency", "inconsistent"))
    assert verify(store)[1] == [f"{file}: its cells have changed since it was written"]
    with pytest.raises(StoreError, match="nowhere is not a store"):
        verify(Store(tmp_path / "nowhere"))


def test_variants_and_scenes_are_verified_each_by_its_own_rule(
    store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    names = ("variants/a-b", "variants/failed-b", "variants/.a.building", "scenes/c", "scenes/.c")
    for name in names:
        (store.path / name).mkdir()
    for module in (variant, scenes):
        monkeypatch.setattr(module, "verify", lambda folder: [f"{folder}/x: wrong"])
    wrong = ("variants/a-b", "scenes/c")
    assert verify(store)[1] == [f"{store.path}/{name}/x: wrong" for name in wrong]
