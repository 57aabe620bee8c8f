"""Tests of packed stores: what is in the archive, what is not, and what it is once unpacked."""

from __future__ import annotations

import tarfile
from dataclasses import replace
from pathlib import Path

import msgspec
import pytest

from tests.conftest import composed
from tests.store.cells import finished, identity, row, write_variant
from xrgs.errors import StoreError
from xrgs.mixture import saved_variant
from xrgs.safeio.files import list_names
from xrgs.store.archive import Copied, pack
from xrgs.store.cell_folder import CellFolder
from xrgs.store.store import Store, unchanged_record

CELLS = ("c1", "c2")


@pytest.fixture
def store(tmp_path: Path) -> Store:
    """A store of two done cells on one variant, and the record of their sweep."""
    store = Store(tmp_path / "my store")
    store.prepare()
    variant_id = write_variant(store.variants)
    (store.variants / variant_id / saved_variant.LOG).write_text(f"{tmp_path}: matched")
    for name, path in zip(CELLS, (f"{tmp_path}/data/fern", "/elsewhere/horns"), strict=True):
        conf = replace(composed("scene=folder", f"scene.path={path}"), store=str(store.path))
        cell = finished(store.cell(name), conf, identity(0, variant_id))
        (cell.path / "log.txt").write_text(f"{tmp_path}: begun")
    command = ["+ablation=x,y", f"scene.path={tmp_path}/data/fern,/elsewhere/horns", "threads=1"]
    store.write_sweep(command, [row(name) for name in CELLS])
    return store


def pack_all(store: Store, out: Path) -> Copied:
    return pack(store, store.cell_folders(), out, out.parent)


def unpacked(archive: Path, folder: Path) -> Store:
    with tarfile.open(archive) as stream:
        stream.extractall(folder, filter="data")
    return Store(folder / "xrgs-store")


def contents(store: Store) -> dict[str, bytes]:
    files = (path for path in store.path.rglob("*") if path.is_file())
    return {str(path.relative_to(store.path)): path.read_bytes() for path in files}


@pytest.mark.slow
def test_an_unpacked_store_is_the_store_trimmed(store: Store, tmp_path: Path) -> None:
    before = contents(store)
    packed = pack_all(store, tmp_path / "a.tar.xz")
    assert str(packed) == "2 cells, 1 variant, 1 record of sweeps"
    assert packed.bytes == (tmp_path / "a.tar.xz").stat().st_size
    assert packed.left_out == ()
    assert contents(store) == before
    pack_all(store, tmp_path / "c.tar.xz")
    assert (tmp_path / "a.tar.xz").read_bytes() == (tmp_path / "c.tar.xz").read_bytes()
    other = unpacked(tmp_path / "a.tar.xz", tmp_path / "other")
    assert other.sweep_ids() == store.sweep_ids()
    for name in CELLS:
        store.cell(name).trim()
        assert other.cell(name).state().name == "done"
        assert other.cell(name).verify() == []
        assert other.cell(name).status().trimmed == store.cell(name).status().trimmed != {}
    unchanged_record(other.sweeps / f"{other.sweep_ids()[0]}.json")
    columns = ["cell_id", "psnr", "gaussians"]
    assert other.cells()[columns].equals(store.cells()[columns])
    (variant,) = list_names(other.variants)
    assert set(contents(other)) == {
        *(f"cells/{name}/{file}" for name in CELLS for file in store.cell(name).status().files),
        *(f"cells/{name}/status.json" for name in CELLS),
        *(
            f"variants/{variant}/{file}"
            for file in (saved_variant.MANIFEST, saved_variant.POINTS, saved_variant.REPORT)
        ),
        f"sweeps/{store.sweep_ids()[0]}.json",
    }
    assert variant.startswith("trimmed-")
    pack_all(other, tmp_path / "b.tar.xz")
    again = unpacked(tmp_path / "b.tar.xz", tmp_path / "again")
    assert contents(again) == contents(other)


@pytest.mark.slow
def test_full_paths_become_relative(store: Store, tmp_path: Path) -> None:
    pack_all(store, tmp_path / "a.tar.xz")
    other = unpacked(tmp_path / "a.tar.xz", tmp_path / "other")
    assert not any(str(tmp_path).encode() in content for content in contents(other).values())
    assert [other.cell(name).config().scene.path for name in CELLS] == ["data/fern", "horns"]
    assert other.cell("c1").config().store == "my store"
    command = other.sweep_record().command
    assert command == ("+ablation=x,y", "scene.path=data/fern,horns", "threads=1")


def test_paths_in_quotes_and_in_errors_become_relative(store: Store, tmp_path: Path) -> None:
    paths = f"'{tmp_path}/my fern','/elsewhere/my horns/**'"
    failed = msgspec.structs.replace(row("c2"), error=f"scene.path={tmp_path}/my fern: few views")
    rows = [row("c1"), failed]
    sweep_id = store.write_sweep(["+ablation=[x,y]", f"scene.path={paths}", "x.y=1/2"], rows)
    pack_all(store, tmp_path / "a.tar.xz")
    other = unpacked(tmp_path / "a.tar.xz", tmp_path / "other")
    record = unchanged_record(other.sweeps / f"{sweep_id}.json")
    assert record.command[1:] == ("scene.path='my fern','my horns/**'", "x.y=1/2")
    assert record.cells[1].error == "scene.path=my fern: few views"


@pytest.mark.slow
def test_the_records_are_those_of_the_sweeps_that_are_named(store: Store, tmp_path: Path) -> None:
    (first,) = store.sweep_ids()
    second = store.write_sweep(["+ablation=x"], [row("c1", "x")])
    store.write_sweep(["+ablation=x"], [row("of no packed cell", "x", seed=1)])
    for sweeps, ids in (((), {first, second}), ((second,), {second})):
        cells = store.cell_folders()
        packed = pack(store, cells, tmp_path / "a.tar.xz", tmp_path, sweeps)
        assert (packed.cells, packed.sweeps) == (2, len(ids))
        other = unpacked(tmp_path / "a.tar.xz", tmp_path / f"of {len(ids)}")
        assert {*other.sweep_ids()} == ids


@pytest.mark.slow
def test_what_is_damaged_is_left_out_and_named(store: Store, tmp_path: Path) -> None:
    (store.cell("c1").path / "scores.csv").write_text("view,psnr\na,21\n")
    (variant_id,) = list_names(store.variants)
    (store.variants / variant_id / saved_variant.POINTS).write_bytes(b"other points")
    packed = pack(store, store.cell_folders(), tmp_path / "a.tar.xz", tmp_path, ["gone"])
    assert (packed.cells, packed.variants, packed.sweeps) == (1, 0, 0)
    cell, variant, record = packed.left_out
    assert cell.startswith("c1: ")
    assert "scores.csv: it has changed since the cell finished" in cell
    assert f"{saved_variant.POINTS}: it has changed" in variant
    assert "gone.json: No such file" in record
    other = unpacked(tmp_path / "a.tar.xz", tmp_path / "other")
    assert other.cell_folders() == [CellFolder(other.cells_folder / "c2")]


@pytest.mark.slow
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
