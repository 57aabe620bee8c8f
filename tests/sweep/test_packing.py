"""Tests of packed stores: what is in the archive, what is not, and what it is once unpacked."""

from __future__ import annotations

import json
import tarfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from xrgs.capture import frozen
from xrgs.capture.frozen import Manifest, ViewEntry
from xrgs.errors import StoreError
from xrgs.experiment.store import Store
from xrgs.safeio.atomic import write_json
from xrgs.safeio.hashing import file_digest
from xrgs.sweep.packing import Packed, pack

CELLS = ("c1", "c2")


@pytest.fixture
def store(cells: Any, tmp_path: Path) -> Store:
    """A store of two done cells on one variant, and the record of their sweep."""
    store: Store = cells.store
    next(store.variants.iterdir()).rmdir()
    variant_id = freeze(store)
    for name in CELLS:
        path = f"{tmp_path}/data/fern" if name == "c1" else "/elsewhere/horns"
        scene = replace(cells.conf.scene, path=path, name="a/b")
        cell = cells.begin(name, {"variant": variant_id}, scene=scene)
        (cell.path / "renders").mkdir()
        (cell.path / "renders" / "a.png").write_bytes(b"render")
        (cell.path / "splats.ply").write_bytes(b"Gaussians")
        (cell.path / "log.txt").write_text(f"{tmp_path}: begun")
        cells.finish(cell)
    command = ["+ablation=x,y", f"scene.path={tmp_path}/data/fern,/elsewhere/horns", "threads=1"]
    store.write_sweep(command, [cells.row(name, "fern", name) for name in CELLS])
    return store


def freeze(store: Store) -> str:
    """Freeze a variant of two photographs; return its id."""
    folder = store.variants / "new"
    (folder / "images").mkdir(parents=True)
    (folder / frozen.LOG).write_text("/home: matched")
    for name in (frozen.POINTS, frozen.REPORT):
        (folder / name).write_text(name)
    views = []
    for split in ("train", "test"):
        (folder / "images" / f"{split}.png").write_bytes(b"photograph")
        size, eye = (60, 40), np.eye(4).tolist()
        file = f"images/{split}.png"
        views.append(ViewEntry(split, split, file, "HR", *size, np.eye(3).tolist(), eye, 1.0))
    files = {name: file_digest(folder / name) for name in (frozen.POINTS, *(v.file for v in views))}
    manifest = Manifest("0123456789abcdef", "fern", 5, False, tuple(views), files)
    manifest = msgspec.structs.replace(manifest, id=manifest.computed_id())
    write_json(folder / frozen.MANIFEST, msgspec.to_builtins(manifest))
    folder.rename(store.variants / manifest.id)
    return manifest.id


def pack_all(store: Store, out: Path) -> Packed:
    return pack(store, store.cell_rows(), out, out.parent)


def unpacked(archive: Path, folder: Path) -> Store:
    with tarfile.open(archive) as stream:
        stream.extractall(folder, filter="data")
    return Store(folder / "xrgs-store")


def contents(store: Store) -> dict[str, bytes]:
    files = (path for path in store.path.rglob("*") if path.is_file())
    return {str(path.relative_to(store.path)): path.read_bytes() for path in files}


def test_an_unpacked_store_is_the_store_trimmed(store: Store, tmp_path: Path) -> None:
    before = contents(store)
    packed = pack_all(store, tmp_path / "a.tar.xz")
    assert str(packed) == "2 cells, 1 variant, 1 record of sweeps"
    assert packed.bytes == (tmp_path / "a.tar.xz").stat().st_size
    assert packed.left_out == ()
    assert contents(store) == before
    other = unpacked(tmp_path / "a.tar.xz", tmp_path / "other")
    assert other.sweep_ids() == store.sweep_ids()
    for name in CELLS:
        store.cell(name).trim()
        assert other.cell(name).state().name == "done"
        assert other.cell(name).verify() == []
        assert other.cell(name).status().trimmed == store.cell(name).status().trimmed != {}
    other.verify_sweep(other.sweep_ids()[0])
    columns = ["cell_id", "psnr", "gaussians"]
    assert other.cells()[columns].equals(store.cells()[columns])
    kept = set(contents(other))
    (variant,) = (path.name for path in other.variants.iterdir())
    assert kept == {
        *(
            f"cells/{cell}/{file}"
            for cell in CELLS
            for file in store.cell(cell).trimmed_status().files
        ),
        *(f"cells/{cell}/status.json" for cell in CELLS),
        *(f"variants/{variant}/{file}" for file in (frozen.MANIFEST, frozen.POINTS, frozen.REPORT)),
        f"sweeps/{store.sweep_ids()[0]}.json",
    }
    assert variant.startswith("trimmed-")
    pack_all(other, tmp_path / "b.tar.xz")
    again = unpacked(tmp_path / "b.tar.xz", tmp_path / "again")
    assert contents(again) == contents(other)


def test_full_paths_become_relative(store: Store, tmp_path: Path) -> None:
    pack_all(store, tmp_path / "a.tar.xz")
    other = unpacked(tmp_path / "a.tar.xz", tmp_path / "other")
    assert not any(str(tmp_path).encode() in content for content in contents(other).values())
    confs = [other.cell(name).config() for name in CELLS]
    assert [(conf.store, conf.scene.path, conf.scene.name) for conf in confs] == [
        ("s", "data/fern", "a/b"),
        ("s", "horns", "a/b"),
    ]
    command = other.sweep_record().command
    assert command == ("+ablation=x,y", "scene.path=data/fern,horns", "threads=1")


def test_the_records_are_those_of_the_sweeps_that_are_named(
    store: Store, cells: Any, tmp_path: Path
) -> None:
    (first,) = store.sweep_ids()
    second = cells.record(("c1", "fern", "x"))
    rows = store.cell_rows()
    for sweeps, ids in (((), {first, second}), ((second,), {second})):
        packed = pack(store, rows, tmp_path / "a.tar.xz", tmp_path, sweeps)
        assert (packed.cells, packed.sweeps) == (2, len(ids))
        other = unpacked(tmp_path / "a.tar.xz", tmp_path / f"of {len(ids)}")
        assert {*other.sweep_ids()} == ids


def test_equal_stores_give_equal_archives(store: Store, tmp_path: Path) -> None:
    pack_all(store, tmp_path / "a.tar.xz")
    pack_all(store, tmp_path / "b.tar.xz")
    assert (tmp_path / "a.tar.xz").read_bytes() == (tmp_path / "b.tar.xz").read_bytes()


def damage_scores(cell: Path) -> str:
    (cell / "scores.csv").write_text("view,psnr\na,21\n")
    return "scores.csv: it has changed since the cell finished"


def malformed(cell: Path) -> str:
    status = json.loads((cell / "status.json").read_text())
    write_json(cell / "status.json", status | {"files": status["files"] | {"../x": 3}})
    return "damaged: "


@pytest.mark.parametrize("damage", [damage_scores, malformed])
def test_a_damaged_cell_is_left_out_and_named(store: Store, tmp_path: Path, damage: Any) -> None:
    cells = store.cell_rows()
    message = damage(store.cell("c1").path)
    packed = pack(store, cells, tmp_path / "a.tar.xz", tmp_path)
    assert packed.cells == 1
    (line,) = packed.left_out
    assert line.startswith("c1  fern / c1: ")
    assert message in line
    other = unpacked(tmp_path / "a.tar.xz", tmp_path / "other")
    assert [cell.id for cell in other.cell_folders()] == ["c2"]


def test_a_damaged_variant_or_record_is_left_out_and_named(store: Store, tmp_path: Path) -> None:
    cells = store.cell_rows()
    (folder,) = store.variants.iterdir()
    (folder / frozen.POINTS).write_bytes(b"other points")
    cells = [replace(cell, sweeps=("gone",)) for cell in cells]
    packed = pack(store, cells, tmp_path / "a.tar.xz", tmp_path)
    assert (packed.cells, packed.variants, packed.sweeps) == (2, 0, 0)
    variant, record = packed.left_out
    assert f"{frozen.POINTS}: it has changed" in variant
    assert "gone.json: No such file" in record


def test_what_can_not_be_written_is_named_and_an_old_archive_is_kept(
    store: Store, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(StoreError, match=r"missing/a\.tar\.xz: No such file or directory"):
        pack_all(store, tmp_path / "missing" / "a.tar.xz")
    out = tmp_path / "a.tar.xz"
    out.write_bytes(b"old")

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(tarfile.TarFile, "addfile", full)
    with pytest.raises(StoreError, match=r"a\.tar\.xz: No space left on device"):
        pack_all(store, out)
    assert out.read_bytes() == b"old"
    assert {path.name for path in tmp_path.iterdir()} == {"a.tar.xz", "s"}
