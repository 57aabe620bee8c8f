"""Tests of a whole sweep on one store, with its cells on another disk."""

from __future__ import annotations

import json
import tarfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from xrgs.capture import variant
from xrgs.experiment.cell_folder import CellFolder
from xrgs.experiment.store import Store
from xrgs.safeio.records import read_table

pytestmark = pytest.mark.slow

SMOKE = (
    *("scene=motorcycle", "preset=smoke", "train.steps=2", "+ablation=consistency"),
    "track=csv",
)
RunCommand = Callable[..., tuple[int, str, str]]


@pytest.fixture(scope="module")
def swept(
    tmp_path_factory: pytest.TempPathFactory, sweeps_in: Callable[..., Any]
) -> tuple[Any, str]:
    """A finished sweep of two cells, whose folder `cells` is a link, and the printed table."""
    sweeps = sweeps_in(tmp_path_factory.mktemp("whole"))
    (sweeps.folder / "disk").mkdir()
    (sweeps.folder / "s").mkdir()
    (sweeps.folder / "s" / "cells").symlink_to(sweeps.folder / "disk")
    code, table, err = sweeps.run(*SMOKE)
    assert code == 0, err
    assert err.count("training cell") == 2
    return sweeps, table


@pytest.fixture(scope="module")
def store(swept: tuple[Any, str]) -> Store:
    return Store(swept[0].folder / "s")


def baseline(store: Store) -> CellFolder:
    (found,) = [row.folder for row in store.cell_rows() if row.label == "baseline"]
    return found


def has_config(value: object) -> bool:
    """Return whether a JSON value holds a cell's config."""
    if isinstance(value, dict):
        keys = {"train", "components", "store"}
        return keys <= value.keys() or any(map(has_config, value.values()))
    return isinstance(value, list) and any(map(has_config, value))


def test_a_config_is_written_once(swept: tuple[Any, str], store: Store) -> None:
    folder = swept[0].folder
    names = [cell.id for cell in store.cell_folders()]
    assert sorted(path.name for path in (folder / "disk").iterdir()) == names
    files = {file for file in folder.rglob("*.json") if "reports" not in file.parts}
    files |= set((folder / "disk").rglob("*.json"))
    with_config = {file.resolve() for file in files if has_config(json.loads(file.read_text()))}
    assert with_config == {folder / "disk" / name / "config.json" for name in names}


def test_the_curves_of_each_cell_are_tracked(store: Store) -> None:
    for cell in store.cell_folders():
        (file,) = (store.path / "tracking" / "csv").glob(f"*--{cell.id}.csv")
        header, rows = read_table(file)
        table = [dict(zip(header, row, strict=True)) for row in rows]
        losses = [float(row["value"]) for row in table if row["series"] == "history/loss"]
        assert losses == list(cell.history()["loss"])
        assert {"score/psnr", "score/gaussians"} <= {row["series"] for row in table}


def test_cells_on_another_disk_are_found_by_every_command(
    swept: tuple[Any, str], store: Store, run_command: RunCommand
) -> None:
    sweeps, table = swept
    code, again, err = sweeps.run(*SMOKE)
    assert code == 0, err
    assert "training cell" not in err
    assert again == table
    code, listed, err = run_command("store", sweeps.folder, "list", "--store=s")
    assert code == 0, err
    assert listed.count("done") == 2
    assert set(store.cells()["state"]) == {"done"}
    code, report, err = run_command("report", sweeps.folder, "--store=s")
    assert code == 0, err
    assert report == table


def test_the_same_program_gives_the_same_bits(
    swept: tuple[Any, str], store: Store, run_command: RunCommand, tmp_path: Path
) -> None:
    original = baseline(store).path
    before = {file: file.stat().st_mtime_ns for file in original.rglob("*")}
    code, out, err = run_command("sweep", tmp_path, f"rerun={original}", "out=again")
    assert code == 0, out + err
    assert out.startswith("the same, bit for bit: scores.csv, history.csv, splats.ply")
    assert "code, libraries and machine are the same" in err
    assert f"Written to {tmp_path / 'again'}" in out
    assert (tmp_path / "again/splats.ply").read_bytes() == (original / "splats.ply").read_bytes()
    assert {file: file.stat().st_mtime_ns for file in original.rglob("*")} == before


def test_a_sweep_goes_on_from_a_packed_store(
    swept: tuple[Any, str],
    store: Store,
    sweeps_in: Callable[..., Any],
    run_command: RunCommand,
    tmp_path: Path,
) -> None:
    cell = baseline(store)
    built, out = cell.identity().variant, tmp_path / "a.tar.xz"
    packed = ("pack", cell.id, f"--store={store.path}", f"--out={out}")
    assert run_command("store", tmp_path, *packed)[0::2] == (0, "")
    with tarfile.open(out) as archive:
        archive.extractall(tmp_path / "other", filter="data")
    other = Store((tmp_path / "other" / "xrgs-store").rename(tmp_path / "other" / "s"))
    assert [path.name for path in other.variants.iterdir()] == [f"trimmed-{built}"]
    code, table, err = sweeps_in(tmp_path / "other").run(*SMOKE)
    assert code == 0
    assert f"variant {built}: making the images again that xrgs-store trim has removed" in err
    assert "building the mixed-resolution variant" not in err
    assert err.count("training cell") == 1
    assert "consistency" in table
    assert [path.name for path in other.variants.glob("[!.]*")] == [built]
    assert variant.verify(other.variants / built) == []
