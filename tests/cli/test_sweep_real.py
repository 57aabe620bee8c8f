"""Tests of `xrgs-sweep` as a user runs it: a process of its own, which trains in others.

Both are forks of a process that has imported torch (`tests.forks`).
"""

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

from tests.cli.conftest import SMOKE, SWEEP
from xrgs.mixture import variant
from xrgs.safeio.records import read_table
from xrgs.store.cell_folder import CellFolder
from xrgs.store.store import Store

pytestmark = pytest.mark.slow

RunCommand = Callable[..., tuple[int, str, str]]
SweepHere = RunCommand
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


def test_a_moved_store_and_naming_the_backend_that_auto_chooses_are_no_change(
    sweep_here: SweepHere, store: Path
) -> None:
    used = json.loads(next((store / "cells").rglob("provenance.json")).read_text())["backend"]
    store.rename(store.with_name("moved"))
    arguments = ("+ablation=consistency", *SMOKE, "store=moved", "dry_run=true")
    _, _, err = sweep_here(*arguments, f"splat.backend={used}", "threads=1", "data_root=x")
    assert "plan: 2 cells, 2 done" in err
    if used == "native":
        assert "plan: 2 cells, 0 done" in sweep_here(*arguments, "splat.backend=torch")[2]


def test_a_count_matched_cell_has_the_gaussians_of_its_reference(
    forked_command: RunCommand, store: Path
) -> None:
    control = ("+ablation=count_matched", "matched_to=gradient_scaling", *SMOKE, f"store={store}")
    code, out, err = forked_command("sweep", store.parent, *control)
    assert code == 0, err
    assert err.count("training cell") == 2
    assert "3 of 3 cells done" in err
    assert "\r" not in err
    assert "count_matched" in out
    configs = [json.loads(f.read_text()) for f in store.glob("cells/*/config.json")]
    matched = [conf["components"]["count_matched"]["gaussians"] for conf in configs]
    counts = [json.loads(f.read_text())["gaussians"] for f in store.glob("cells/*/summary.json")]
    assert max(matched) in counts


def test_a_corrupt_cell_is_trained_again(
    forked_command: RunCommand, store: Path, contents: Contents
) -> None:
    cell = sorted((store / "cells").iterdir())[0]
    before = contents(cell)
    scores = cell / "scores.csv"
    scores.write_text(scores.read_text().replace("0.", "0.9", 1))
    code, _, err = forked_command("sweep", store.parent, *SWEEP)
    assert code == 0
    assert "corrupt" in err
    assert "1 done" in err
    # It is trained again to the same bits; the corrupt folder is kept beside it.
    assert contents(cell)["splats.ply"] == before["splats.ply"]
    assert contents(cell)["scores.csv"] == before["scores.csv"]
    assert cell.with_name(f"{cell.name}.aside-1").is_dir()


def test_a_scene_that_fails_leaves_the_other_scenes(
    forked_command: RunCommand, store: Path, photographs: Callable[..., Path]
) -> None:
    flat = photographs(store.parent / "flat", 6)
    (store.parent / "mine/scene").mkdir(parents=True)
    text = f"name: flat\nkind: folder\npath: {flat}\n"  # the embedded scene has no path
    (store.parent / "mine/scene/flat.yaml").write_text(text)
    scenes = ("scene=motorcycle,flat", "--config-dir", "mine")
    arguments = ("+ablation=consistency", *SMOKE[1:], *scenes, "store=s")
    code, out, err = forked_command("sweep", store.parent, *arguments)
    assert code == 1
    assert "flat" in err
    assert "registered" in err
    assert "failed" in out
    assert "Training time" in out  # the table of the other scene


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


def baseline(store: Store) -> CellFolder:
    (found,) = [row.folder for row in store.cell_rows() if row.label == "baseline"]
    return found


def test_the_curves_of_each_cell_are_tracked(store: Path) -> None:
    for cell in Store(store).cell_folders():
        (file,) = (store / "tracking" / "csv").glob(f"*--{cell.id}.csv")
        header, rows = read_table(file)
        table = [dict(zip(header, row, strict=True)) for row in rows]
        losses = [float(row["value"]) for row in table if row["series"] == "history/loss"]
        assert losses == list(cell.history()["loss"])
        assert {"score/psnr", "score/gaussians"} <= {row["series"] for row in table}


def test_cells_on_another_disk_are_found_by_every_command(
    swept: tuple[Path, str], forked_command: RunCommand, tmp_path: Path
) -> None:
    home, table = swept
    folder = Path(shutil.copytree(home, tmp_path / "copy", symlinks=True))
    assert (folder / "s" / "cells").is_symlink()
    files = [file for file in (home / "disk").rglob("*") if file.is_file()]
    written = {file: file.stat().st_mtime_ns for file in files}
    code, again, err = forked_command("sweep", folder, *SWEEP)
    assert code == 0, err
    assert "plan: 2 cells, 2 done" in err
    assert "training cell" not in err
    assert again == table
    assert {file: file.stat().st_mtime_ns for file in files} == written
    code, listed, err = forked_command("store", folder, "list", "--store=s")
    assert code == 0, err
    assert listed.count("done") == 2
    assert set(Store(folder / "s").cells()["state"]) == {"done"}
    assert "Next:" in table


def test_the_same_program_gives_the_same_bits(
    forked_command: RunCommand, store: Path, tmp_path: Path
) -> None:
    original = baseline(Store(store)).path
    before = {file: file.stat().st_mtime_ns for file in original.rglob("*")}
    code, out, err = forked_command("sweep", tmp_path, f"rerun={original}", "out=again")
    assert code == 0, out + err
    assert out.startswith("the same, bit for bit: scores.csv, history.csv, splats.ply")
    assert "code, libraries and machine are the same" in err
    assert f"Written to {tmp_path / 'again'}" in out
    assert (tmp_path / "again/splats.ply").read_bytes() == (original / "splats.ply").read_bytes()
    assert {file: file.stat().st_mtime_ns for file in original.rglob("*")} == before


def test_a_sweep_goes_on_from_a_packed_store(
    forked_command: RunCommand, store: Path, tmp_path: Path
) -> None:
    cell = baseline(Store(store))
    built, out = cell.identity().variant, tmp_path / "a.tar.xz"
    packed = ("pack", cell.id, f"--store={store}", f"--out={out}")
    assert forked_command("store", tmp_path, *packed)[0::2] == (0, "")
    with tarfile.open(out) as archive:
        archive.extractall(tmp_path / "other", filter="data")
    other = Store((tmp_path / "other" / "xrgs-store").rename(tmp_path / "other" / "s"))
    assert [path.name for path in other.variants.iterdir()] == [f"trimmed-{built}"]
    code, table, err = forked_command("sweep", tmp_path / "other", *SWEEP)
    assert code == 0
    assert f"variant {built}: making the images again that xrgs-store trim has removed" in err
    assert "building the mixed-resolution variant" not in err
    assert err.count("training cell") == 1
    assert "consistency" in table
    assert [path.name for path in other.variants.glob("[!.]*")] == [built]
    assert variant.verify(other.variants / built) == []
