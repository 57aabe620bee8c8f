"""Tests of `xrgs-sweep` with real trainings, in this process (`tests.conftest.work_here`)."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
import tarfile
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.conftest import SMOKE, SWEEP
from xrgs.mixture import variant
from xrgs.safeio.records import read_table
from xrgs.store.cell_folder import CellFolder
from xrgs.store.store import Store

pytestmark = pytest.mark.slow

RunCommand = Callable[..., tuple[int, str, str]]
Contents = Callable[[Path], dict[str, str]]


def test_a_sweep_ends_with_the_table_and_keeps_all_that_a_reader_may_need(
    swept: tuple[Path, str], contents: Contents
) -> None:
    folder, out = swept
    for label in ("Training time", "Gaussians", "Memory", "LPIPS", "SSIM", "PSNR", "n/a"):
        assert label in out
    assert "one replicate: no interval" in out
    assert "↑" in out or "↓" in out
    (written,) = map(folder.joinpath, re.findall(r"^Page: (.*)/report\.html$", out, re.MULTILINE))
    assert {"table.md", "table.tex", "table.csv"} <= {file.name for file in written.iterdir()}
    cells = sorted((folder / "s" / "cells").iterdir())
    assert len(cells) == 2
    for cell in cells:
        assert set(contents(cell)) == {
            *("config.json", "history.csv", "identity.json", "log.txt", "provenance.json"),
            *("renders/motorcycle_left.png", "renders/motorcycle_right.png", "scores.csv"),
            *("splats.ply", "status.json", "summary.json"),
        }
        assert json.loads((cell / "provenance.json").read_text())["packages"]["torch"]


def test_cells_on_another_disk_are_found_by_every_command(
    swept: tuple[Path, str], sweep_here: RunCommand, call_command: RunCommand, tmp_path: Path
) -> None:
    home, table = swept
    folder = Path(shutil.copytree(home, tmp_path / "copy", symlinks=True))
    assert (folder / "s" / "cells").is_symlink()
    words = [word for word in SWEEP if not word.startswith("store=")]
    code, _, err = sweep_here(*words, f"store={folder / 's'}", "dry_run=true")
    assert code == 0, err
    assert "plan: 2 cells, 2 done" in err
    code, listed, err = call_command("store", "list", f"--store={folder / 's'}")
    assert code == 0, err
    assert listed.count("done") == 2
    assert set(Store(folder / "s").cells()["state"]) == {"done"}
    assert "Next:" in table


def test_a_moved_store_and_naming_the_backend_that_auto_chooses_are_no_change(
    sweep_here: RunCommand, store: Path
) -> None:
    used = json.loads(next((store / "cells").rglob("provenance.json")).read_text())["backend"]
    store.rename(store.with_name("moved"))
    arguments = ("+ablation=consistency", *SMOKE, "store=moved", "dry_run=true")
    _, _, err = sweep_here(*arguments, f"splat.backend={used}", "threads=1", "data_root=x")
    assert "plan: 2 cells, 2 done" in err
    if used == "native":
        assert "plan: 2 cells, 0 done" in sweep_here(*arguments, "splat.backend=torch")[2]


def test_the_child_imports_the_package_of_its_parent_and_not_that_of_its_folder(
    tmp_path: Path,
) -> None:
    (tmp_path / "xrgs").mkdir()
    (tmp_path / "xrgs" / "__init__.py").write_text("raise ImportError('the wrong package')")
    script = "import sys; sys.path.remove(''); from xrgs.sweep.job import run_in_child; "
    script += "run_in_child('cell', {'cell': 'gone', 'inode': 0})"
    done = subprocess.run(
        [sys.executable, "-c", script], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert "WorkError: gone: another attempt at the cell has begun" in done.stderr
    assert "the wrong package" not in done.stderr


def test_the_curves_of_each_cell_are_tracked(store: Path) -> None:
    for cell in Store(store).cell_folders():
        (file,) = (store / "tracking" / "csv").glob(f"*--{cell.id}.csv")
        header, rows = read_table(file)
        table = [dict(zip(header, row, strict=True)) for row in rows]
        losses = [float(row["value"]) for row in table if row["series"] == "history/loss"]
        assert losses == list(cell.history()["loss"])
        assert {"score/psnr", "score/gaussians"} <= {row["series"] for row in table}


@pytest.mark.usefixtures("here")
def test_the_same_program_gives_the_same_bits(sweep_here: RunCommand, store: Path) -> None:
    original = baseline(Store(store)).path
    before = {file: file.stat().st_mtime_ns for file in original.rglob("*")}
    code, out, err = sweep_here(f"rerun={original}", "out=again")
    assert code == 0, out + err
    assert out.startswith("the same, bit for bit: scores.csv, history.csv, splats.ply")
    assert "code, libraries and machine are the same" in err
    again = store.parent / "again"
    assert f"Written to {again}" in out
    assert (again / "splats.ply").read_bytes() == (original / "splats.ply").read_bytes()
    assert {file: file.stat().st_mtime_ns for file in original.rglob("*")} == before


def baseline(store: Store) -> CellFolder:
    (found,) = [row.folder for row in store.cell_rows() if row.label == "baseline"]
    return found


@pytest.fixture
def damaged(store: Path, tmp_path: Path, call_command: RunCommand) -> Store:
    """The unpacked archive of that store, in which the baseline's scores have been changed."""
    packed = ("pack", f"--store={store}", f"--out={tmp_path / 'a.tar.xz'}")
    assert call_command("store", *packed)[0::2] == (0, "")
    with tarfile.open(tmp_path / "a.tar.xz") as archive:
        archive.extractall(tmp_path / "other", filter="data")
    other = Store((tmp_path / "other" / "xrgs-store").rename(tmp_path / "unpacked"))
    scores = baseline(other).path / "scores.csv"
    scores.write_text(scores.read_text().replace("0.", "0.9", 1))
    return other


@pytest.mark.usefixtures("here")
def test_a_sweep_goes_on_from_a_packed_store_with_a_corrupt_cell_and_a_scene_that_fails(
    sweep_here: RunCommand,
    store: Path,
    damaged: Store,
    tmp_path: Path,
    photographs: Callable[..., Path],
    contents: Contents,
) -> None:
    cell = baseline(damaged)
    built = cell.identity().variant
    assert [path.name for path in damaged.variants.iterdir()] == [f"trimmed-{built}"]
    before = contents(store / "cells" / cell.id)
    text = f"name: flat\nkind: folder\npath: {photographs(tmp_path / 'flat', 6)}\n"
    (tmp_path / "mine/scene").mkdir(parents=True)
    (tmp_path / "mine/scene/flat.yaml").write_text(text)  # the embedded scene has no path
    scenes = ("scene=motorcycle,flat", "--config-dir", "mine", "store=unpacked", "threads=1")
    arms = ("+ablation=consistency,count_matched", "matched_to=consistency")
    code, table, err = sweep_here(*arms, *SMOKE[1:], *scenes)
    assert code == 1  # of the other scene
    assert "registered" in err
    assert "failed" in table
    assert "Training time" in table  # of this scene
    assert "consistency" in table
    assert "\r" not in err
    # The images of the trimmed variant are made again, and nothing is built.
    assert f"variant {built}: making the images again that xrgs-store trim has removed" in err
    assert err.count("building the mixed-resolution variant") == 1
    assert [path.name for path in damaged.variants.glob("[!.]*-*") if built[:16] in path.name] == [
        built
    ]
    assert variant.verify(damaged.variants / built) == []
    # The corrupt cell is trained again to the same bits; the corrupt folder is kept beside it.
    assert "corrupt" in err
    assert "1 done" in err
    assert err.count("training cell") == 2
    for name in ("splats.ply", "scores.csv"):
        assert contents(cell.path)[name] == before[name]
    assert cell.path.with_name(f"{cell.id}.aside-1").is_dir()
    # The count-matched cell is to reach the Gaussians of its reference.
    rows = {row.label: row.folder for row in damaged.cell_rows() if row.scene == "motorcycle"}
    control = rows["count_matched to consistency"]
    assert control.state().name == "done"
    count = rows["consistency"].summary().gaussians
    assert control.config().components.count_matched.gaussians == count
