"""Tests of packed stores: what is in the archive, what is not, and what it is once unpacked."""

from __future__ import annotations

import json
import tarfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from xrgs.capture import frozen
from xrgs.errors import StoreError
from xrgs.experiment.attempts import begin_attempt
from xrgs.experiment.store import Store
from xrgs.safeio.atomic import write_json
from xrgs.safeio.hashing import file_digest
from xrgs.sweep.inventory import summaries
from xrgs.sweep.packing import Packed, pack

CELLS = ("c1", "c2")


@pytest.fixture
def store(tmp_path: Path) -> Store:
    """A store of two done cells on one variant, and the record of their sweep."""
    store = Store(tmp_path / "my store")
    store.prepare()
    folder = store.variants / "new"
    (folder / "images").make_folder()
    (folder / "images" / "a.png").path.write_bytes(b"photograph")
    (folder / frozen.LOG).path.write_text(f"{tmp_path}: matched")
    for name in (frozen.POINTS, frozen.REPORT):
        (folder / name).path.write_text(name)
    manifest = {"key": "k", "files": {frozen.POINTS: file_digest(folder / frozen.POINTS)}}
    variant_id = frozen.variant_id(manifest)
    write_json(folder / frozen.MANIFEST, manifest)
    folder.rename(store.variants / variant_id)
    for name in CELLS:
        add_cell(store, name, variant_id, tmp_path)
    rows = [{"cell_id": name, "scene": "fern", "label": name} for name in CELLS]
    command = ["+ablation=x,y", f"scene.path={tmp_path}/data/fern,/elsewhere/horns", "threads=1"]
    store.write_sweep(command, rows)
    return store


def add_cell(store: Store, name: str, variant_id: str, here: Path) -> None:
    config = {
        "store": str(store.path),
        "scene": {"path": f"{here}/data/fern", "views": [f"/elsewhere/{name}", 3], "name": "a/b"},
    }
    folder = store.cell(name)
    begin_attempt(folder, config, {"variant": variant_id, "seed": 0})
    (folder.path / "renders").mkdir()
    (folder.path / "renders" / "a.png").write_bytes(b"render")
    (folder.path / "splats.ply").write_bytes(b"Gaussians")
    (folder.path / "log.txt").write_text(f"{here}: begun")
    (folder.path / "scores.csv").write_text("view,psnr\na,20\n")
    (folder.path / "summary.json").write_text('{"gaussians": 17}')
    folder.finish(["a"], 1)


def pack_all(store: Store, out: Path) -> Packed:
    return pack(store, summaries(store), out, out.parent)


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
        assert other.cell(name).trimmed() == store.cell(name).trimmed() != {}
    other.verify_sweep(other.sweep_ids()[0])
    columns = ["cell_id", "psnr", "gaussians"]
    assert other.cells()[columns].equals(store.cells()[columns])
    kept = set(contents(other))
    (variant,) = other.variants.names()
    assert kept == {
        *(
            f"cells/{cell}/{file}"
            for cell in CELLS
            for file in store.cell(cell).trimmed_status()["files"]
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
    assert json.loads((other.cell("c1").path / "config.json").read_text()) == {
        "store": "my store",
        "scene": {"path": "data/fern", "views": ["c1", 3], "name": "a/b"},
    }
    command = other.sweep_record()["command"]
    assert command == ["+ablation=x,y", "scene.path=data/fern,horns", "threads=1"]


def test_the_records_are_those_of_the_sweeps_that_are_named(store: Store, tmp_path: Path) -> None:
    (first,) = store.sweep_ids()
    second = store.write_sweep(["+ablation=x"], [{"cell_id": "c1", "scene": "fern", "label": "x"}])
    cells = summaries(store)
    for sweeps, ids in (((), {first, second}), ((second,), {second})):
        packed = pack(store, cells, tmp_path / "a.tar.xz", tmp_path, sweeps)
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


def escape(cell: Path) -> str:
    return change_files(
        cell, {"../../sweeps/x": {"bytes": 1, "sha256": ""}}, "not a file of this cell"
    )


def malformed(cell: Path) -> str:
    return change_files(cell, {"scores.csv": 3}, "a file is malformed")


def change_files(cell: Path, files: dict[str, Any], message: str) -> str:
    status = json.loads((cell / "status.json").read_text())
    write_json(cell / "status.json", status | {"files": status["files"] | files})
    return message


@pytest.mark.parametrize("damage", [damage_scores, escape, malformed])
def test_a_damaged_cell_is_left_out_and_named(store: Store, tmp_path: Path, damage: Any) -> None:
    cells = summaries(store)
    message = damage(store.cell("c1").path)
    packed = pack(store, cells, tmp_path / "a.tar.xz", tmp_path)
    assert packed.cells == 1
    (line,) = packed.left_out
    assert line.startswith("c1  fern / c1: ")
    assert message in line
    other = unpacked(tmp_path / "a.tar.xz", tmp_path / "other")
    assert [cell.id for cell in other.cell_folders()] == ["c2"]


def test_a_damaged_variant_or_record_is_left_out_and_named(store: Store, tmp_path: Path) -> None:
    cells = summaries(store)
    (variant_id,) = store.variants.names()
    (store.variants / variant_id / frozen.POINTS).path.write_bytes(b"other points")
    cells = [replace(cell, names=replace(cell.names, sweeps=("gone",))) for cell in cells]
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
    assert {path.name for path in tmp_path.iterdir()} == {"a.tar.xz", "my store"}
