"""Tests of a whole sweep on one store, with its cells on another disk."""

from __future__ import annotations

import shutil
import tarfile
from collections.abc import Callable
from pathlib import Path

import pytest

from xrgs.mixture import variant
from xrgs.safeio.records import read_table
from xrgs.store.cell_folder import CellFolder
from xrgs.store.store import Store

pytestmark = pytest.mark.slow

SMOKE = (
    *("scene=motorcycle", "preset=smoke", "train.steps=2", "+ablation=consistency"),
    *("track=csv", "threads=1", "store=s"),
)
RunCommand = Callable[..., tuple[int, str, str]]


@pytest.fixture(scope="module")
def swept(
    tmp_path_factory: pytest.TempPathFactory, forked_command: RunCommand, smoke_variants: Path
) -> tuple[Path, str]:
    """A folder with a finished sweep of two cells in its store `s`, and the printed table.

    The store's folder `cells` is a link.
    """
    folder = tmp_path_factory.mktemp("whole")
    (folder / "disk").mkdir()
    shutil.copytree(smoke_variants, folder / "s" / "variants")
    (folder / "s" / "cells").symlink_to(folder / "disk")
    code, table, err = forked_command("sweep", folder, *SMOKE)
    assert code == 0, err
    assert err.count("training cell") == 2
    return folder, table


@pytest.fixture(scope="module")
def store(swept: tuple[Path, str]) -> Store:
    return Store(swept[0] / "s")


def baseline(store: Store) -> CellFolder:
    (found,) = [row.folder for row in store.cell_rows() if row.label == "baseline"]
    return found


def test_the_curves_of_each_cell_are_tracked(store: Store) -> None:
    for cell in store.cell_folders():
        (file,) = (store.path / "tracking" / "csv").glob(f"*--{cell.id}.csv")
        header, rows = read_table(file)
        table = [dict(zip(header, row, strict=True)) for row in rows]
        losses = [float(row["value"]) for row in table if row["series"] == "history/loss"]
        assert losses == list(cell.history()["loss"])
        assert {"score/psnr", "score/gaussians"} <= {row["series"] for row in table}


def test_cells_on_another_disk_are_found_by_every_command(
    swept: tuple[Path, str], store: Store, forked_command: RunCommand
) -> None:
    folder, table = swept
    files = [file for file in (folder / "disk").rglob("*") if file.is_file()]
    written = {file: file.stat().st_mtime_ns for file in files}
    code, again, err = forked_command("sweep", folder, *SMOKE)
    assert code == 0, err
    assert "plan: 2 cells, 2 done" in err
    assert "training cell" not in err
    assert again == table
    assert {file: file.stat().st_mtime_ns for file in files} == written
    code, listed, err = forked_command("store", folder, "list", "--store=s")
    assert code == 0, err
    assert listed.count("done") == 2
    assert set(store.cells()["state"]) == {"done"}
    assert "Next:" in table


def test_the_same_program_gives_the_same_bits(
    swept: tuple[Path, str], store: Store, forked_command: RunCommand, tmp_path: Path
) -> None:
    original = baseline(store).path
    before = {file: file.stat().st_mtime_ns for file in original.rglob("*")}
    code, out, err = forked_command("sweep", tmp_path, f"rerun={original}", "out=again")
    assert code == 0, out + err
    assert out.startswith("the same, bit for bit: scores.csv, history.csv, splats.ply")
    assert "code, libraries and machine are the same" in err
    assert f"Written to {tmp_path / 'again'}" in out
    assert (tmp_path / "again/splats.ply").read_bytes() == (original / "splats.ply").read_bytes()
    assert {file: file.stat().st_mtime_ns for file in original.rglob("*")} == before


def test_a_sweep_goes_on_from_a_packed_store(
    swept: tuple[Path, str], store: Store, forked_command: RunCommand, tmp_path: Path
) -> None:
    cell = baseline(store)
    built, out = cell.identity().variant, tmp_path / "a.tar.xz"
    packed = ("pack", cell.id, f"--store={store.path}", f"--out={out}")
    assert forked_command("store", tmp_path, *packed)[0::2] == (0, "")
    with tarfile.open(out) as archive:
        archive.extractall(tmp_path / "other", filter="data")
    other = Store((tmp_path / "other" / "xrgs-store").rename(tmp_path / "other" / "s"))
    assert [path.name for path in other.variants.iterdir()] == [f"trimmed-{built}"]
    code, table, err = forked_command("sweep", tmp_path / "other", *SMOKE)
    assert code == 0
    assert f"variant {built}: making the images again that xrgs-store trim has removed" in err
    assert "building the mixed-resolution variant" not in err
    assert err.count("training cell") == 1
    assert "consistency" in table
    assert [path.name for path in other.variants.glob("[!.]*")] == [built]
    assert variant.verify(other.variants / built) == []
